"""A designed motion: its table, files for the robot, and figure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import yaml
from matplotlib.figure import Figure
from torch import Tensor

from pinn_dyn.atomic_files import write_whole
from pinn_dyn.identification.motion_limits import Envelope
from pinn_dyn.identification.rigid_excitation import RigidExcitation
from pinn_dyn.plots import COLORS, panels, save

_MESSAGE_RATE = 20  # points per second: ros2_control interpolates, and a shell limits a message


@dataclass(frozen=True)
class DesignedMotion:
    """A motion with known forces, within the limits of a robot.

    Attributes:
        envelope: the robot and its limits.
        t: times at 1 kHz, ``(T,)``, s.
        q, v, a: positions, velocities and accelerations, ``(T, N)``; SI units and radians.
        tau: torques or forces by the inertias of the URDF, without friction, ``(T, N)``.
        excitation: condition number of the base parameters, and undetermined directions.
        random_condition: median condition number of random motions within the same limits.
    """

    envelope: Envelope
    t: Tensor
    q: Tensor
    v: Tensor
    a: Tensor
    tau: Tensor
    excitation: RigidExcitation
    random_condition: float

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints in the URDF."""
        return self.envelope.robot.joint_names

    def uses(self) -> pd.DataFrame:
        """Return the largest part of each limit that each joint uses."""
        uses = self.envelope.uses(self.q, self.v, self.a, self.tau)
        columns = {name: x.amax(0).numpy() for name, x in uses.items()}
        return pd.DataFrame({"joint": self.joint_names, **columns})

    def table(self, rate: float = 100.0) -> pd.DataFrame:
        """Return t, and q, v, a and tau of each joint, at a sample rate in Hz."""
        table = {"t": self.t}
        for name in ("q", "v", "a", "tau"):
            columns = getattr(self, name).unbind(-1)
            table |= {f"{name}_{x}": y for x, y in zip(self.joint_names, columns, strict=True)}
        return pd.DataFrame(table)[:: self._stride(rate)]

    def joint_trajectory(self, approach: float = 5.0) -> str:
        """Return a ROS ``trajectory_msgs/JointTrajectory`` as YAML in braces.

        The controller moves the robot from its pose to the start of the motion in ``approach`` s.
        """
        names = ("positions", "velocities", "accelerations")
        points = []
        for k in range(0, len(self.t), self._stride(_MESSAGE_RATE)):
            seconds, nanoseconds = divmod(round(1e9 * (approach + float(self.t[k]))), 10**9)
            values = [[float(f"{y:.6g}") for y in x[k].tolist()] for x in (self.q, self.v, self.a)]
            time = {"sec": seconds, "nanosec": nanoseconds}
            points.append({**dict(zip(names, values, strict=True)), "time_from_start": time})
        message = {"joint_names": self.joint_names, "points": points}
        return yaml.safe_dump(message, default_flow_style=True, sort_keys=False, width=120)

    def figure(self) -> Figure:
        """Draw positions, velocities and torques, with dashed limits."""
        limits, short = self.envelope, slice(None, None, self._stride(100.0))
        bounds = [(limits.low, limits.high), *((-x, x) for x in (limits.velocity, limits.torque))]
        turning = self.envelope.robot.turning
        units = {"q": ("m", "rad"), "v": ("m/s", "rad/s"), "tau": ("N", "Nm")}
        columns = [
            [f"{x} {name} [{pair[k]}]" for name, k in zip(self.joint_names, turning, strict=True)]
            for x, pair in units.items()
        ]
        figure, axes = panels(columns, self.t, title=self._summary())
        for column, values, (low, high) in zip(
            axes, (self.q, self.v, self.tau), bounds, strict=True
        ):
            for ax, x, *ends in zip(column, values[short].T, low, high, strict=True):
                ax.plot(self.t[short], x, color=COLORS[0])
                for end in (float(x) for x in ends if x.isfinite()):
                    ax.axhline(end, color=COLORS[1], linestyle="--", linewidth=1)
        return figure

    def save(self, folder: str | Path, rate: float = 100.0, approach: float = 5.0) -> None:
        """Write motion.csv, joint_trajectory.yaml and motion.png."""
        path = Path(folder)
        path.mkdir(parents=True, exist_ok=True)
        table = self.table(rate)
        write_whole(path / "motion.csv", table.to_csv(index=False, float_format="%.9g"))
        write_whole(path / "joint_trajectory.yaml", self.joint_trajectory(approach))
        save(self.figure(), path / "motion.png")

    def __str__(self) -> str:
        table = self.uses().to_string(index=False, float_format="{:.0%}".format)
        return f"{self._summary()}\nlargest part of the limits:\n{table}"

    def _summary(self) -> str:
        return (
            f"condition number of {self.excitation.count} base parameters: "
            f"{self.excitation.condition:.3g} (random motions: {self.random_condition:.3g})"
        )

    def _stride(self, rate: float) -> int:
        return max(1, round(1 / (rate * float(self.t[1]))))
