"""Seeds a thread by a pixel of an image, and shows where it was found.

suturetrack source --source stage:figure8-175 --loop 300 &     # a system without a seed
suturetrack segmenter &
suturetrack tracker &
python examples/seed_by_pixel.py 454 118
python examples/seed_by_pixel.py 454 118 right
"""

import sys

import numpy as np

from services.client import Refused, connect
from suturetrack import nurbs


def main(u: str, v: str, view: str = "left", rig: str = "rig") -> int:
    """Seeds once; the exit status is 1 when there is no thread."""
    with connect(rig) as client:
        try:
            found = client.seed((float(u), float(v)), view="right" if view == "right" else "left")
        except Refused as refusal:
            print(f"refused: {refusal}")
            for near in refusal.candidates:
                print("  looks like thread: {:.0f} {:.0f}".format(*near))
            return 1
        assert found.curve is not None
        start, end = 1000 * nurbs.evaluate(found.curve, np.array([0.0, 1.0]))
        print(f"{found.reason}\nfrom {start.round(1)} mm to {end.round(1)} mm")
        return 0


if __name__ == "__main__":
    if not 3 <= len(sys.argv) <= 5:
        sys.exit("usage: seed_by_pixel.py U V [left|right] [RIG]")
    try:
        sys.exit(main(*sys.argv[1:]))
    except ValueError as error:  # InputError too: no system runs, or a bad name.
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
