"""Origin of the numbers in the reports of evaluate.py and control.py."""

import pinn_dyn
from pinn_dyn.data import data_identity
from pinn_dyn.run.provenance import data_hash
from tests.app.entry import TINY_DATA


def test_the_hash_of_data_depends_on_their_numbers_alone():
    settings = dict(word[8:].split("=") for word in TINY_DATA)

    def hash_of(**more):
        return data_hash(data_identity(pinn_dyn.dataset("soft_arm_1", **settings, **more)))

    assert hash_of() == hash_of() != hash_of(seed=1)
