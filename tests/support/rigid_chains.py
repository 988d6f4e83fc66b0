"""A small tree of bodies with every kind of joint, as the text of a URDF."""


def link(name, mass=1.0, centre="0.1 0.02 -0.03", moments="0.02 0.001 0.03 -0.002 0.003 0.025"):
    ixx, ixy, iyy, ixz, iyz, izz = moments.split()
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre}" rpy="0.1 -0.2 0.3"/>'
        f'<mass value="{mass}"/><inertia ixx="{ixx}" ixy="{ixy}" ixz="{ixz}" iyy="{iyy}" '
        f'iyz="{iyz}" izz="{izz}"/></inertial></link>'
    )


def joint(name, kind, parent, child, xyz="0 0 0.3", rpy="0.4 0.1 -0.5", axis="0 1 0"):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
        '<limit lower="-2" upper="2" effort="10" velocity="3"/></joint>'
    )


def robot(*parts):
    return f'<robot name="small">{"".join(parts)}</robot>'


TREE = robot(
    link("base"),
    link("shoulder", 2.0),
    link("slider", 0.7),
    link("elbow", 1.2),
    link("bracket", 0.4),
    link("branch", 0.5),
    link("hand", 0.3),
    joint("turn", "revolute", "base", "shoulder", axis="0 0 1"),
    joint("slide", "prismatic", "shoulder", "slider", axis="1 2 2"),
    joint("weld", "fixed", "slider", "bracket", xyz="0.2 0 0.1"),
    joint("bend", "continuous", "bracket", "elbow", xyz="0.3 0 0"),
    joint("fork", "revolute", "shoulder", "branch", xyz="0 0.2 0.1", axis="-1 0 0"),
    joint("wrist", "revolute", "elbow", "hand", xyz="0.25 0 0", axis="1 0 0"),
)
"""Four joints that move, a fork, a weld and, once it is locked, a wrist."""
