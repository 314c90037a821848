# Set-up, demo and tests; every target makes and reuses .venv.

PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: venv peers browser demo test test-slow fuzz lint types unit live notebooks bench library clean

venv: $(STAMP)

$(STAMP): pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "make: $(PYTHON) not found; set PYTHON=..."; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "make: installing the package and what it needs into $(VENV); some minutes"
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	@echo "make: compiling what sessions run, so that none waits for it later; half a minute"
	$(BIN)/traitbrdf compile
	touch $(STAMP)

# The path tracer that tests/test_peers.py and `traitbrdf bench --peers` compare with; it needs
# Debian's libllvm19 as well.
peers: venv
	$(BIN)/python -m pip install --quiet --editable ".[peers]"

# A browser and JupyterLab for tests/test_browser.py, where they can be installed; what checks
# exported glTF files, at fixed versions: before 0.181 three.js did not filter maps by GGX.
browser: venv
	$(BIN)/python -m pip install --quiet --editable ".[browser]" \
		|| echo "make: no playwright or jupyterlab: the browser tests are skipped"
	@command -v npm >/dev/null && npm install --silent --no-fund --no-audit --prefix $(VENV)/npm \
		gltf-validator@2.0.0-dev.3.10 three@0.187.0 >/dev/null || echo "make: no npm: exported glTF files are not validated"
	@command -v chromium >/dev/null || { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null \
		&& apt-get update -qq && DEBIAN_FRONTEND=noninteractive \
		apt-get install -y -qq --no-install-recommends chromium >/dev/null; } \
		|| echo "make: no chromium: the browser tests are skipped"

# Paint "shiny" on the teapot's handle: pictures and report.json go to out/demo.
demo: venv
	$(BIN)/traitbrdf demo --out out/demo

test: lint types unit

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: venv
	$(BIN)/mypy

# Two processes of one thread each: they take two thirds of the time of one with two threads.
unit: venv
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

# Whatever takes more than a few seconds: real browsers, whole benches, a rebuild of the artifact.
test-slow: browser
	$(BIN)/python -m pytest -n 2 --dist worksteal -m slow

# Feed every reader 10,000 damaged files: some 40 minutes, for EXR files most of all.
fuzz: venv
	TRAITBRDF_MUTATIONS=10000 $(BIN)/python -m pytest -n 2 --dist worksteal \
		tests/test_damaged_files.py -k many

bench: venv
	$(BIN)/traitbrdf bench

# Paint in the page and in JupyterLab by a browser: frames a second, latency, and screenshots.
live: browser
	$(BIN)/python tests/bench/live.py --out out/live

# Rebuild the artifact that the package ships.
library: venv
	$(BIN)/python -m data_gen

clean:
	rm -rf $(VENV) build dist out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
