"""Write the log of a simulated desktop arm on position servos, such as an SO-101.

As in data sets for imitation learning, it has targets (action) and joint angles in degrees at
50 Hz, and no velocities or torques.

    python examples/write_servo_log.py [file]
    python check.py --config-dir=examples/conf dataset=servo_arm
"""

import sys

import mujoco
import numpy as np
import pandas as pd

EPISODES, SECONDS, RATE, SUBSTEPS, SEED = 12, 10, 50, 20, 0
JOINTS = {  # axis, length of the link in m, mass in kg, gain in Nm/rad
    "shoulder_pan": ("0 0 1", 0.06, 0.15, 18.0),
    "shoulder_lift": ("0 1 0", 0.12, 0.12, 18.0),
    "elbow_flex": ("0 1 0", 0.13, 0.10, 14.0),
    "wrist_flex": ("0 1 0", 0.06, 0.07, 9.0),
    "wrist_roll": ("0 0 1", 0.05, 0.05, 6.0),
}


def arm() -> mujoco.MjModel:
    """Build the arm, with servos that saturate at 3 Nm, rotors, viscous and dry friction."""
    bodies, actuators, height = "", "", 0.0
    for name, (axis, length, mass, gain) in JOINTS.items():
        bodies += (
            f'<body pos="0 0 {height}"><joint name="{name}" axis="{axis}" armature="0.01" '
            f'damping="0.6" frictionloss="0.05"/><geom type="capsule" size="0.02" mass="{mass}" '
            f'fromto="0 0 0 0 0 {length}" contype="0"/>'
        )
        actuators += f'<position joint="{name}" kp="{gain}" forcerange="-3 3"/>'
        height = length
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{1 / RATE / SUBSTEPS}"/><worldbody>{bodies}'
        f"{'</body>' * len(JOINTS)}</worldbody><actuator>{actuators}</actuator></mujoco>"
    )


def episode(robot: mujoco.MjModel, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return targets and angles ``(T, 5)``, rad, under slow sines with small steps."""
    data = mujoco.MjData(robot)
    t = np.arange(SECONDS * RATE) / RATE
    frequencies, phases = rng.uniform([[0.1]], [[0.9]], (4, 5)), rng.uniform(0, 6.3, (4, 5))
    targets = np.sin(6.28 * frequencies * t[:, None, None] + phases).sum(1) * 0.25
    targets += np.repeat(rng.uniform(-0.15, 0.15, (SECONDS, 5)), RATE, axis=0)
    angles = []
    for target in targets:
        angles.append(data.qpos + rng.normal(0, 5e-4, 5))
        data.ctrl[:] = target
        mujoco.mj_step(robot, data, SUBSTEPS)
    return targets, np.array(angles)


def main(path: str) -> None:
    robot, rng = arm(), np.random.default_rng(SEED)
    frames = []
    for number in range(EPISODES):
        targets, angles = np.degrees(episode(robot, rng))
        frame = {"episode_index": number, "timestamp": np.arange(len(angles)) / RATE}
        vectors = {"action": list(targets), "observation.state": list(angles)}
        frames.append(pd.DataFrame(frame | vectors))
    pd.concat(frames).to_parquet(path)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "servo_arm.parquet")
