"""Small linear algebra that the mechanics share."""

import torch

from pinn_dyn.mechanics.arrays import spd_solve


def test_a_matrix_that_is_not_positive_definite_spoils_its_own_row_alone():
    root = torch.randn(4, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    matrix = root @ root.mT + 0.1 * torch.eye(3, dtype=torch.float64)
    expected = torch.randn(4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    vector = (matrix @ expected.unsqueeze(-1)).squeeze(-1)
    matrix[1, 2, 2] = -1.0
    matrix[3, 0, 0] = torch.nan
    found = spd_solve(matrix, vector)
    torch.testing.assert_close(found[[0, 2]], expected[[0, 2]], rtol=1e-10, atol=1e-10)
    assert found[[1, 3]].isnan().all()
