"""An arm picks up a load, and its law adapts to the load.

python examples/adaptive_tracking.py    writes law.c for the controller of the robot
"""

from pathlib import Path

import torch

from pinn_dyn.control import AdaptiveTracking, Pipeline, Sines, SystemPlant, export_law
from pinn_dyn.systems import RigidChain

URDF, PERIOD = str(Path(__file__).with_name("double_pendulum.urdf")), 0.004
reference = Sines([0.5, 0.4], [0.6, 0.5], [0.6, 1.0])
model = RigidChain(URDF, damping=0.1)  # or run.system of an identified robot
heavy = RigidChain(URDF, damping=0.1)
point = torch.tensor([0.0, 0.0, -0.2, 1.0], dtype=torch.float64)
heavy.inertia[1] += 0.3 * torch.outer(point, point)  # 0.3 kg at the end of the second link

for name, rate in (("fixed model", 1e-9), ("adaptive", 60.0)):
    law = Pipeline(AdaptiveTracking(model, 8.0, 1.0, rate=rate, adapt=["payload"]), PERIOD)
    motion = reference(0.0)
    q, v = motion.q[None], motion.v[None]
    memory = torch.zeros(1, law.memory_size).double()
    errors = []
    for k in range(1000):
        if k in (0, 250):  # the load comes after 1 s
            plant = SystemPlant(heavy if k else model, rtol=1e-4, atol=1e-6)
            plant.start(q, v)
        motion = reference(k * PERIOD)
        u, status, memory, report = law.call(q, v, motion, memory)
        errors.append(float((q - motion.q).norm()))
        q, v = plant.advance(u, PERIOD)
    late = 1e3 * max(errors[750:])
    mass = float(report["adapted_mass"][0])
    print(f"{name}: error {late:.1f} mrad two seconds later, mass {mass:.2f} kg (0.80)")

export_law(law, "law.c")
