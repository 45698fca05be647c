"""Prints what is known of every thread, frame by frame, and says when it may not be acted on.

suturetrack demo                      # in one terminal
python examples/watch_states.py       # in another
"""

import sys

from services.client import connect
from suturetrack.types import InputError, Status


def main(rig: str = "rig") -> None:
    """Prints until Ctrl-C."""
    with connect(rig) as client:
        for seen in client.states():
            state = seen.state
            if not seen.live:
                print(f"thread {state.thread}: STALE, {seen.reason}", flush=True)
            elif state.status is Status.LOST:
                print(f"thread {state.thread}: lost", flush=True)
            else:
                print(
                    f"thread {state.thread}: frame {state.stamp.frame}, {state.status}, "
                    f"{1000 * state.length:.1f} mm, {100 * state.seen.mean():.0f} % seen, "
                    f"{seen.freshness.age_ns / 1e6:.0f} ms old, {client.missed} missed",
                    flush=True,
                )


if __name__ == "__main__":
    if len(sys.argv) > 2:
        sys.exit("usage: watch_states.py [RIG]")
    try:
        main(*sys.argv[1:])
    except InputError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
