"""The `fathomlink` command: a light module, since all that it can do takes a second to import."""

import os
import signal
import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one subcommand; return 0, or 2 with one line on stderr that says what is wrong.

    A standard stream that is closed becomes the null device, lest a file be opened in its place.
    Ctrl-C while modules are imported ends the process at once, in one line as well.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w" if number else "r", encoding="utf-8"))
    is_heeded = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if is_heeded:  # in the background it may be ignored
        signal.signal(signal.SIGINT, _end)
    from host_tools import command_line  # noqa: PLC0415  (see above)

    if is_heeded:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return command_line.main(arguments)


def _end(*_: object) -> None:
    os.write(2, b"fathomlink: interrupted\n")
    os._exit(2)


if __name__ == "__main__":
    sys.exit(main())
