"""Contract suites: written once, inherited by the tests of every implementation."""

import pytest

# The suites are no test files by name, so pytest has to be told to explain their assertions.
pytest.register_assert_rewrite("tests.contracts.mechanical_system")
