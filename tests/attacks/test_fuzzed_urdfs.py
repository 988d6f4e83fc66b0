"""URDFs that hypothesis damages: refused in a sentence with the file, or a robot with masses.

How to look for more of them: see test_fuzzed_logs.py.
"""

import time
import xml.etree.ElementTree as ET

import torch
from hypothesis import given
from hypothesis import strategies as st

from pinn_dyn.systems import RigidChain
from pinn_dyn.systems.urdf import read_urdf
from tests.attacks.damage import byte_hits, hit, places
from tests.support.arm_urdf import ARM

TAGS = [
    *("link", "joint", "inertial", "mass", "inertia", "origin", "axis", "limit", "parent", "child"),
]
KEYS = [
    *("name", "type", "link", "xyz", "rpy", "value", "ixx", "ixy", "izz"),
    *("lower", "upper", "effort"),
]
VALUES = [
    *("", "base", "upper", "lower", "tool", "0", "-1", "1e300", "1e-300", "nan", "inf", "0 0 0"),
    *("1 0 0", "0 0 1e-7", "1 2", "1,2,3", "fixed", "revolute", "continuous", "prismatic"),
    *("planar", "floating", "mimic", "\u00bd", "0x1", "1_0", "\u0661 0 0", "a" * 300, "${pi}"),
]
values = st.sampled_from(VALUES) | st.floats().map(repr) | st.text("abc<&é 0.-", max_size=6)


def without_element(robot, where, *_):
    parents = [(parent, child) for parent in robot.iter() for child in parent]
    if parents:
        parent, child = parents[where % len(parents)]
        parent.remove(child)


def with_attribute(robot, where, key, value):
    elements = list(robot.iter())
    element = elements[where % len(elements)]
    names = [*element.attrib, key]
    element.set(names[len(key + value) % len(names)], value)


def with_tag(robot, where, tag, _):
    elements = list(robot.iter())
    elements[where % len(elements)].tag = tag


def with_copy(robot, where, _, value):
    elements = list(robot.iter())
    element = elements[where % len(elements)]
    parent = elements[len(value) % len(elements)]
    if element not in parent.iter() and parent not in element.iter():
        parent.append(element)


edits_of_tree = st.tuples(
    st.sampled_from([without_element, with_attribute, with_attribute, with_tag, with_copy]),
    places,
    st.sampled_from(KEYS + TAGS),
    values,
)


def refused(read, path):
    """What was read; None where it was refused by a sentence with the file."""
    try:
        return read(path)
    except (ValueError, FileNotFoundError) as error:
        said = str(error)
    assert str(path) in said
    assert len(said) < 900
    return None


@given(st.lists(edits_of_tree, min_size=1, max_size=4), byte_hits(0, 1))
def test_a_damaged_robot_is_refused_or_one(tmp_path_factory, edits, hits):
    robot = ET.fromstring(ARM)
    for change, *arguments in edits:
        change(robot, *arguments)
    path = tmp_path_factory.mktemp("urdf") / "arm.urdf"
    path.write_bytes(hit(ET.tostring(robot, encoding="utf-8"), hits))
    start = time.perf_counter()
    refused(lambda file: read_urdf(file, [], "file"), path)
    chain = refused(lambda file: RigidChain(str(file)), path)
    assert time.perf_counter() - start < 10
    if chain is not None:
        q = torch.full((chain.num_coordinates,), 0.3, dtype=torch.float64)
        mass = chain.mass_matrix(q)
        assert mass.isfinite().all()
        assert torch.linalg.eigvalsh(mass)[0] > -1e-9 * float(mass.abs().max())
