"""Write the law and the robot of loop.c: tracking with an observer and limits, a double pendulum.

python examples/realtime/export.py [--run runs/double_pendulum/lnn]    writes law.c and plant.c here
"""

import argparse
from pathlib import Path

import pinn_dyn
from pinn_dyn.control import Actuator, DisturbanceObserver, Tracking, export_law
from pinn_dyn.mechanics import double_copy
from pinn_dyn.run.export import export
from pinn_dyn.systems import RigidChain

here = Path(__file__).parent
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--run", help="a run folder whose model the law uses; default: the true arm")
parser.add_argument("--folder", type=Path, default=here)
args = parser.parse_args()

arm = RigidChain(str(here.parent / "double_pendulum.urdf"))
model = double_copy(pinn_dyn.load(args.run).system if args.run else arm)
law = DisturbanceObserver(Tracking(model, 20.0, 2.0), bandwidth=50.0)
actuator = Actuator(low=-20.0, high=20.0, rate=2000.0)
print(export_law(law, args.folder / "law.c", actuator=actuator, period=1e-3))
print(export(arm, args.folder / "plant.c", "step"))
