"""Inertial combinations beside a URDF's: python -m benchmarks.base_parameters <run>."""

import sys
from pathlib import Path

import numpy as np
import torch
from scipy.linalg import qr

from pinn_dyn.models import KnownMechanics
from pinn_dyn.run.run_folder import load_run
from pinn_dyn.systems import RigidChain

STATES = 3000
CARRIES = 0.005  # of the largest torque that one combination makes


def main(folder: Path) -> None:
    """Print how far the combinations that carry torque are from those of the URDF.

    The columns of Y in M a + C v + G = Y pi that a pivoted QR decomposition finds independent, at
    random states, belong to the base parameters; the others are counted into them. Source: Gautier
    1991, "Numerical calculation of the base inertial parameters of robots". The truth is the URDF
    of the structure, without armature.
    """
    model = load_run(folder, "best", ()).model.double()
    assert isinstance(model, KnownMechanics)
    assert isinstance(model.structure, RigidChain)
    generator = torch.Generator().manual_seed(0)
    q, v, a = (
        3 * torch.rand(STATES, model.num_coordinates, generator=generator).double() - 1.5
        for _ in range(3)
    )
    regressor = torch.cat([model.structure.regressor(q, v, a), torch.diag_embed(a)], dim=-1)
    columns = regressor.flatten(0, 1).numpy()
    true = torch.cat([model.structure.parameters_of().flatten(), 0 * model.armature()])
    found = torch.cat([model.body_parameters().flatten(), model.armature()])
    _, triangle, order = qr(columns, mode="economic", pivoting=True)
    diagonal = np.abs(triangle.diagonal())
    rank = int((diagonal > 1e-8 * diagonal[0]).sum())
    rest = np.linalg.solve(triangle[:rank, :rank], triangle[:rank, rank:])
    base = np.concatenate([np.eye(rank), rest], axis=1)
    expected, learned = (base @ x.detach().numpy()[order] for x in (true, found))
    torque = np.abs(expected) * np.linalg.norm(columns[:, order[:rank]], axis=0)
    carries = torque > CARRIES * torque.max()
    error = np.abs(learned / expected - 1)[carries]
    print(f"{rank} combinations, {carries.sum()} with {CARRIES:.1%} of the largest torque or more")
    print(f"of these within 1 %: {(error < 0.01).sum()}; the worst is {error.max():.2%} off")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
