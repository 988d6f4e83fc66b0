"""The packages of the wheel; everything else is in pyproject.toml."""

from setuptools import find_packages, setup

# conf/ lies at the top level, beside the entry scripts; in the wheel it is inside the package.
setup(
    packages=[*find_packages(include=["pinn_dyn", "pinn_dyn.*"]), "pinn_dyn.conf"],
    package_dir={"pinn_dyn.conf": "conf"},
)
