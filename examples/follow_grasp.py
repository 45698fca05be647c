"""Follows the pose at which a gripper would take the thread 10 mm before its end.

    suturetrack demo                      # in one terminal
    python examples/follow_grasp.py       # in another

The pose comes in the rectified left camera; a robot needs its hand-eye calibration on top. Where there
is none, the gripper holds still: that is the point of the exercise.
"""

import sys

from services.client import Refused, connect
from suturetrack.types import InputError

FROM_END_M = 0.010
APPROACH = (0.0, 0.0, 1.0)  # away from the camera


def main(rig: str = "rig") -> None:
    """Follows until Ctrl-C."""
    with connect(rig) as client:
        for seen in client.states("0"):
            newest = client.latest("0")
            if newest is not None and newest.state.stamp > seen.state.stamp:
                continue  # a newer one is waiting already
            try:
                pose = client.grasp("0", from_end=FROM_END_M, approach=APPROACH)
            except Refused as refusal:
                print(f"hold still: {refusal}", flush=True)
                continue
            x, y, z = 1000 * pose.position
            jaw = pose.rotation[:, 0].round(3)
            print(
                f"frame {pose.stamp.frame}: move to {x:+.2f} {y:+.2f} {z:+.2f} mm "
                f"(± {1000 * pose.sigma:.2f}), approach along {jaw}",
                flush=True,
            )


if __name__ == "__main__":
    if len(sys.argv) > 2:
        sys.exit("usage: follow_grasp.py [RIG]")
    try:
        main(*sys.argv[1:])
    except InputError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
