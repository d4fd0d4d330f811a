# Every target sets up what it needs: Python 3.11 and make are enough.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
FUZZ_SECONDS ?= 10
LINK_SEEDS ?= 10000
MISSION_SEEDS ?= 200
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

.PHONY: demo test slow coverage check bench bench-compression reproduce fuzz faults hil wheel clean

$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	touch $@

demo: $(READY)
	$(BIN)/fathomlink demo --out out/demo

test: $(READY)
	$(BIN)/python -m pytest -m "not slow" --quiet

slow: $(READY)
	$(BIN)/python -m pytest -m slow

coverage: $(READY)
	$(BIN)/python -m pytest tests/protocol tests/modems/test_sealed.py -m "not slow" --quiet \
		$(addprefix --cov=protocol.,codec crc framing reassembly seal seal_state modems.sealed) \
		--cov-branch --cov-fail-under=100 --cov-report=term-missing

hil: $(READY)
	$(BIN)/python -m pytest hil

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(READY)
	$(BIN)/python -m benchmarks.wire
	$(BIN)/python -m benchmarks.link
	$(BIN)/python -m benchmarks.matching
	$(BIN)/python -m benchmarks.map_vote
	$(BIN)/python -m benchmarks.compression

bench-compression: $(READY)
	$(BIN)/python -m benchmarks.compression

reproduce: $(READY)
	$(BIN)/fathomlink reproduce --out out/reproduce

fuzz: $(READY)
	$(BIN)/python -m pip install --quiet --editable ".[fuzz]"
	$(BIN)/python -m tests.fuzz.run --seconds $(FUZZ_SECONDS)

faults: $(READY)
	$(BIN)/fathomlink faults --tier link --seeds $(LINK_SEEDS)
	$(BIN)/fathomlink faults --tier mission --seeds $(MISSION_SEEDS)

wheel: $(READY)
	sh .ci/wheel

clean:
	rm -rf $(VENV) out build dist *.egg-info
