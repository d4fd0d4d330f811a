"""Fuzz with atheris: python -m tests.fuzz.run [TARGET] [--seconds 60]; without target, all in turn.

Starts from tests/fuzz/corpus/TARGET; what libFuzzer adds goes to out/fuzz/TARGET. An input that
fails is left there as crash-*; put it into the corpus once mended, and it is tested for ever.
"""

import argparse
import subprocess
import sys
from pathlib import Path

try:
    import atheris  # type: ignore[import-not-found,import-untyped,unused-ignore]
except ImportError:
    sys.exit("fuzzing needs atheris; type: pip install -e '.[fuzz]'")

with atheris.instrument_imports(include=["protocol", "firmware.compression"]):
    from tests.fuzz.targets import TARGETS

CORPUS = Path(__file__).parent / "corpus"
LARGEST_INPUT_BYTES = 2048
SLOWEST_S, LARGEST_MEMORY_MB = 5, 1024
"""Beyond these an input counts as a hang or as growth."""


def main(arguments: list[str]) -> int:
    """Run one target, or all, until the time is over or an input fails; return the status."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.run", description=__doc__)
    parser.add_argument("target", nargs="?", choices=sorted(TARGETS))
    parser.add_argument("--seconds", type=int, default=60, help="for each target")
    options = parser.parse_args(arguments)
    if options.target is not None:
        fuzz(options.target, options.seconds)
        return 0
    command = [sys.executable, "-m", "tests.fuzz.run", "--seconds", str(options.seconds)]
    done = [subprocess.run([*command, target], check=False).returncode for target in TARGETS]
    return max(map(abs, done))


def fuzz(target: str, seconds: int) -> None:
    """Fuzz one target; libFuzzer ends the process itself."""
    found = Path("out") / "fuzz" / target
    found.mkdir(parents=True, exist_ok=True)
    options = [
        f"-max_total_time={seconds}",
        f"-max_len={LARGEST_INPUT_BYTES}",
        f"-timeout={SLOWEST_S}",
        f"-rss_limit_mb={LARGEST_MEMORY_MB}",
        f"-artifact_prefix={found}/",
        "-print_final_stats=1",
        str(found),
        str(CORPUS / target),
    ]
    atheris.Setup([sys.argv[0], *options], TARGETS[target])
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
