"""`suturetrack VERB ...`: every verb is a configuration and a function, loaded when it is called."""

from __future__ import annotations

import ctypes
import errno
import importlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata

from services import RUST_LOG

# Each process keeps to one core: they run side by side, and results do not depend on the machine.
_ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)
for _name in _ONE_THREAD:
    os.environ.setdefault(_name, "1")
# What is wrong with a video is said once, by us.
os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
os.environ.setdefault("RUST_LOG", RUST_LOG)

_INTERRUPTED = 130
"""The exit status after Ctrl-C, as shells count it."""


@dataclass(frozen=True)
class _Verb:
    module: str
    config: str
    purpose: str
    process: bool = False
    """Whether it is a process of the dataflow."""


VERBS = {
    "demo": _Verb("services.launch", "DemoConfig", "track a synthetic thread for 20 s, recorded"),
    "run": _Verb("services.launch", "RunConfig", "track threads in a video, a folder, a camera"),
    "reconstruct": _Verb(
        "services.reconstruct", "ReconstructConfig", "one stereo pair to one curve, as JSON"
    ),
    "inspect": _Verb("services.inspect", "InspectConfig", "tables of a run"),
    "compare": _Verb("services.compare", "CompareConfig", "several runs side by side"),
    "replay": _Verb("services.replay", "ReplayConfig", "a run once more through today's code"),
    "export": _Verb(
        "services.export", "ExportConfig", "the states of a run as JSON lines or a table (CSV)"
    ),
    "view": _Verb("services.view", "ViewConfig", "a run, or what runs now, in the Rerun viewer"),
    "seed": _Verb("services.seed", "SeedConfig", "tell the running tracker where a thread is"),
    "grasp": _Verb("services.grasp", "GraspConfig", "ask where a gripper should take a thread"),
    "calibration": _Verb(
        "services.calibration", "CalibrationConfig", "check a calibration, also against images"
    ),
    "status": _Verb("services.status", "StatusConfig", "what runs, live in the terminal"),
    "doctor": _Verb("services.doctor", "DoctorConfig", "what is wrong, and what to do"),
    "router": _Verb("services.router", "RouterConfig", "pass messages between hosts"),
    "keys": _Verb("services.keys", "KeysConfig", "certificates and access rules for several hosts"),
    "record": _Verb("services.record", "RecordConfig", "record what runs, until stopped", True),
    "console": _Verb("services.console", "ConsoleConfig", "the operator's page: watch and seed"),
    "tooltip": _Verb(
        "services.tooltip", "TooltipConfig", "the process that lets the tip of a tool seed", True
    ),
    "scenes": _Verb("services.scenes", "ScenesConfig", "pictures of the synthetic bench top"),
    "bench": _Verb("services.bench", "BenchConfig", "accuracy and speed beside references"),
    "source": _Verb("services.source", "SourceConfig", "the process that releases frames", True),
    "segmenter": _Verb(
        "services.segmenter", "SegmenterConfig", "the process that makes ridge fields", True
    ),
    "tracker": _Verb(
        "services.tracker", "TrackerConfig", "the process that holds the threads", True
    ),
    "ros2": _Verb("services.ros2", "Ros2Config", "the process that bridges to ROS 2", True),
}


def main() -> None:
    """The command `suturetrack`."""
    arguments = sys.argv[1:]
    try:
        status = call(arguments)
        sys.stdout.flush()
    except KeyboardInterrupt:
        status = _INTERRUPTED
    except OSError as error:
        # Who read has seen enough, as `| head` does.
        if error.errno not in (errno.EPIPE, errno.ENOSPC):
            raise
        if error.errno == errno.ENOSPC:
            print(f"suturetrack: cannot write: {error.strerror}", file=sys.stderr)
        # The interpreter would complain once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 1
    if arguments and arguments[0] in VERBS and VERBS[arguments[0]].process:
        _leave(status)
    sys.exit(status)


def call(arguments: Sequence[str]) -> int:
    """Runs one verb; the exit status is 0, 1 for input that is at fault, 2 for a wrong call.

    Raises:
        SystemExit: for --help, and for options that do not exist or do not parse.
    """
    garbled = [argument for argument in arguments if not _is_text(argument)]
    if garbled:
        print(
            f"suturetrack: {garbled[0]!r} is not UTF-8; give files and folders names that are",
            file=sys.stderr,
        )
        return 2
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return 0
    if arguments[0] == "--version":
        print(f"suturetrack {metadata.version('suturetrack')}")
        return 0
    name, *options = arguments
    if name not in VERBS:
        print(f"suturetrack: no verb {name!r}; there are {', '.join(VERBS)}", file=sys.stderr)
        return 2
    return _run(name, VERBS[name], options)


def _is_text(argument: str) -> bool:
    """Whether an argument can be encoded; bytes that are not UTF-8 arrive as what cannot."""
    try:
        argument.encode()
    except UnicodeEncodeError:
        return False
    return True


def _run(name: str, verb: _Verb, arguments: list[str]) -> int:
    with _quick_to_interrupt():
        # Late, so that the overview and wrong verbs are quick.
        from services.arguments import parse
        from suturetrack.types import InputError

        module = importlib.import_module(verb.module)
        kind = getattr(module, verb.config)
        config = parse(kind, f"suturetrack {name}", arguments)
    try:
        if verb.process:
            from services import service

            logging.basicConfig(format=f"{name}: %(message)s", level=logging.INFO)
            service.run(name, config.service, lambda running: module.run(running, config))
        else:
            module.run(config)
    except InputError as error:
        print(f"suturetrack {name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return _INTERRUPTED
    return 0


@contextmanager
def _quick_to_interrupt() -> Iterator[None]:
    """SIGINT ends the process at once and without a word.

    A module that is being loaded has nothing to complete, and may swallow the exception or tell of it.
    """
    in_charge = threading.current_thread() is threading.main_thread()
    if not in_charge or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, lambda *_: os._exit(_INTERRUPTED))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _leave(status: int) -> None:
    """Exits without the interpreter's teardown, which takes half a second for the compilers' sake.

    All is closed by now; the exit handlers of the C library remove the shared memory.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    ctypes.PyDLL(None).exit(status)


def _overview() -> str:
    lines = [
        "usage: suturetrack VERB [OPTIONS]",
        "",
        "Finds a surgical suture thread in stereo video from one seed point and holds a 3-D NURBS",
        "curve on it. `suturetrack VERB --help` tells the options of a verb, `--version` which one this is.",
        "",
    ]
    return "\n".join(lines + [f"  {name:<12} {verb.purpose}" for name, verb in VERBS.items()])


if __name__ == "__main__":
    main()
