# Set-up, demo and tests; every target makes and reuses .venv.

PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: venv peers demo test lint types unit notebooks bench library clean

venv: $(STAMP)

$(STAMP): pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "make: $(PYTHON) not found; set PYTHON=..."; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	touch $(STAMP)

# The path tracer that tests/test_peers.py compares with; it needs Debian's libllvm19 as well.
peers: venv
	$(BIN)/python -m pip install --quiet --editable ".[peers]"

# Paint "shiny" on the teapot's handle: pictures and report.json go to out/demo.
demo: venv
	$(BIN)/traitbrdf demo --out out/demo

test: lint types unit

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: venv
	$(BIN)/mypy

unit: venv
	$(BIN)/python -m pytest

bench: venv
	$(BIN)/traitbrdf bench

# Rebuild the artifact that the package ships.
library: venv
	$(BIN)/python -m data_gen

clean:
	rm -rf $(VENV) build dist out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
