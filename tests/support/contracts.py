"""A contract suite as one case: faster to collect and to run than one case per test."""

import inspect

import pytest


def one_case(suite):
    """Replace the tests of a contract class by one test that runs them all.

    Its fixtures are made once: for objects without memory, which no test changes. A failure names
    the test in which it happened.
    """
    tests = [getattr(suite, name) for name in dir(suite) if name.startswith("test_")]
    names = dict.fromkeys(name for test in tests for name in fixtures_of(test))

    def test_contract(self, **fixtures):
        for test in tests:
            own = {name: fixtures[name] for name in fixtures_of(test)}
            for arguments in arguments_of(test):
                try:
                    test(self, **own, **arguments)
                except Exception as error:
                    error.add_note(f"in {test.__name__} {arguments or ''}")
                    raise

    owner = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    others = [inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY) for name in names]
    test_contract.__signature__ = inspect.Signature([owner, *others])
    for test in tests:
        setattr(suite, test.__name__, None)  # so pytest does not collect it
    suite.test_contract = test_contract
    return suite


def arguments_of(test):
    """Return the sets of arguments by which a test is parametrized: one name at most."""
    marks = getattr(test, "pytestmark", [])
    for mark in marks:
        if mark.name == "parametrize":
            name, values = mark.args
            return [{name: value} for value in values]
    return [{}]


def fixtures_of(test):
    """Return the names of the fixtures of a test."""
    parameters = set(arguments_of(test)[0])
    return [
        name for name in inspect.signature(test).parameters if name not in {"self", *parameters}
    ]


def slow_except(values, fast):
    """Return values to parametrize with, all but the fast ones marked as slow."""
    return [pytest.param(x, marks=() if x in fast else pytest.mark.slow) for x in values]
