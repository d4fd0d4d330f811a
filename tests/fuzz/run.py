"""Fuzz one target with atheris: python -m tests.fuzz.run TARGET [SECONDS]; needs the fuzz extra.

Starts from tests/fuzz/corpus/TARGET; what libFuzzer adds goes to out/fuzz/TARGET. An input that
fails is left there as crash-*; put it into the corpus once mended, and it is tested for ever.
"""

import sys
from pathlib import Path

import atheris  # type: ignore[import-not-found,import-untyped,unused-ignore]

with atheris.instrument_imports(include=["protocol"]):
    from tests.fuzz.targets import TARGETS

CORPUS = Path(__file__).parent / "corpus"
LARGEST_INPUT_BYTES = 2048
SLOWEST_S, LARGEST_MEMORY_MB = 5, 1024
"""Beyond these an input counts as a hang or as growth."""


def main(arguments: list[str]) -> None:
    """Run until the time is over or an input fails."""
    if not arguments or arguments[0] not in TARGETS:
        sys.exit(f"name a target: {', '.join(TARGETS)}")
    name = arguments[0]
    seconds = int(arguments[1]) if len(arguments) > 1 else 60
    found = Path("out") / "fuzz" / name
    found.mkdir(parents=True, exist_ok=True)
    options = [
        f"-max_total_time={seconds}",
        f"-max_len={LARGEST_INPUT_BYTES}",
        f"-timeout={SLOWEST_S}",
        f"-rss_limit_mb={LARGEST_MEMORY_MB}",
        f"-artifact_prefix={found}/",
        "-print_final_stats=1",
        str(found),
        str(CORPUS / name),
    ]
    atheris.Setup([sys.argv[0], *options], TARGETS[name])
    atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1:])
