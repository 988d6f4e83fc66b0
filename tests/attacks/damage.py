"""What hypothesis does to the bytes of a file."""

from hypothesis import strategies as st

places = st.integers(0, 10_000)


def byte_hits(least, most):
    """Where some bytes go, as a share of the file, how many, and what takes their place."""
    one = st.tuples(st.floats(0, 1), st.integers(0, 40), st.binary(max_size=12))
    return st.lists(one, min_size=least, max_size=most)


def hit(content, hits):
    for share, gone, new in hits:
        k = int(share * len(content))
        content = content[:k] + new + content[k + gone :]
    return content
