# `make help` lists the targets. A bare machine needs Python 3.11 or newer, make and git; the rest comes from PyPI.

PYTHON       ?= python3
VENV         ?= .venv
DEMO_LOG     ?= sample_logs/wheeled_lawnmower.mcap
DEMO_OPTIONS ?= --robot segway-rmp400
DEMO_RUN      = icrtool-runs/$(basename $(notdir $(DEMO_LOG)))
BENCH        ?=
FUZZ         ?=
SAMPLES      ?= sample_logs/generate.py
JOBS         ?= 2

BIN   := $(VENV)/bin
READY := $(VENV)/.ready
DEV   := $(VENV)/.ready-dev

# uv, where there is one, installs in a quarter of pip's CPU time.
UV        := $(shell command -v uv 2>/dev/null)
MAKE_VENV := $(if $(UV),$(UV) venv --quiet --no-config --allow-existing --python $(PYTHON) $(VENV),$(PYTHON) -m venv $(VENV))
INSTALL   := $(if $(UV),$(UV) pip install --quiet --no-config --python $(BIN)/python,$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile)
PINNED    := --no-deps --require-hashes -r

# Tests, docs and benchmarks need 163 packages: pip takes 56 s of CPU time for them, uv 8 s; so uv is installed first, by
# its pin. Where uv fails, as with an index set for pip, pip does.
BY_UV      = $(BIN)/uv pip install --quiet --no-config --python $(BIN)/python

# Python then keeps its compiled modules: the commands that the tests run would each compile numpy and numba again.
export PYTHONDONTWRITEBYTECODE =

# A dot every three seconds while the command behind it is silent.
DOTS := (while sleep 3; do printf . >&2; done) & trap "kill $$!; echo >&2" EXIT;

# Compiles what the commands load, and nothing else of a gigabyte: where Python may not write, each would compile it.
LOAD = import pkgutil, icrtool; [__import__(one.name) for one in pkgutil.walk_packages(icrtool.__path__, 'icrtool.')]

.DEFAULT_GOAL := help
AXE           = $(VENV)/axe-core/axe.min.js
AXE_VERSION   = 4.14.1
AXE_SHA256    = 29348999450cdf2849a8e70b7912fc2da85a849da39c0d0d5394f51d4a9ed95c

.PHONY: axe help setup setup-dev demo format format-check lint words types test stress fuzz bench bench-quick unseen docs schemas samples quick where wheel-check check constraints clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-13s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# Two files of pins: constraints.txt holds what icrtool runs on, constraints-dev.txt the rest. Hashes are checked for
# everything that is downloaded; this checkout then builds with the pinned hatchling.
setup: $(READY)  ## make .venv with the pinned packages that icrtool runs on, and this checkout, editable

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "$(PYTHON) is Python " + sys.version.split()[0] + "; icrtool needs 3.11 or newer: make PYTHON=python3.11 ...")'
	@echo "Setting up $(VENV): 43 packages, about 150 MB to fetch; half a minute to two minutes the first time."
	@$(MAKE_VENV)
	@$(DOTS) $(INSTALL) $(PINNED) constraints.txt
	@$(INSTALL) --no-deps --no-build-isolation -e .
	@touch $@

setup-dev: $(DEV)  ## add the pinned packages for tests, docs and benchmarks

$(DEV): $(READY) constraints-dev.txt
	@echo "Adding to $(VENV) what tests, docs and benchmarks need: 163 packages; half a minute to two minutes the first time."
	@mkdir -p build
	@sed -n '/^uv==/,/[^\\]$$/p' constraints-dev.txt >build/uv.txt
	@$(DOTS) $(INSTALL) $(PINNED) build/uv.txt && { $(BY_UV) $(PINNED) constraints-dev.txt || $(INSTALL) $(PINNED) constraints-dev.txt; }
	@$(BIN)/python -c "$(LOAD)"
	@touch $@

demo: $(READY)  ## learn the ICRs of the sample robot, report its GPS dropouts, say where the plots are
	@echo "Fitting $(DEMO_LOG); the first fit on a computer compiles for about 8 s"
	$(BIN)/icrtool fit $(DEMO_LOG) $(DEMO_OPTIONS)
	@echo
	$(BIN)/icrtool dropout-report $(DEMO_RUN)
	@echo "Plots: $(DEMO_RUN)/plots/ and $(DEMO_RUN)/dropout/plots/"

format: $(DEV)  ## format the code and sort the imports
	$(BIN)/ruff format .
	$(BIN)/ruff check --select I --fix .

format-check: $(DEV)
	$(BIN)/ruff format --check .

lint: $(DEV)  ## ruff, and the spelling
	$(BIN)/ruff check .
	$(BIN)/codespell

words: $(DEV)  ## count the words that CONTRIBUTING.md asks to avoid, by package
	@$(BIN)/python tests/test_language.py

where: $(READY)  ## where something is in the code: make where WORDS="wheel radius"
	@$(BIN)/python scripts/where.py $(WORDS)

types: $(DEV)  ## mypy, strict
	$(BIN)/mypy

# Two processes, each with whole files of tests: fixtures of a module are made once. In the order of the folders: files of
# few tests are among the longest, and xdist would leave them for the end, when one process waits.
test: $(DEV)  ## the tests, without the stress tests; JOBS=0 runs them in one process
	$(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile --no-loadscope-reorder

PKG ?= kernels
quick: $(DEV)  ## ruff, mypy and the tests of one package, below a minute: make quick PKG=alignment
	@$(BIN)/ruff check --quiet icrtool/$(PKG) tests/unit/$(PKG)
	@$(BIN)/mypy --no-error-summary
	$(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile tests/unit/$(PKG) tests/test_architecture.py

stress: $(DEV)  ## the long and large tests alone
	$(BIN)/python -m pytest -q -m stress

fuzz: $(DEV)  ## use damaged logs, or forged runs; FUZZ="--logs 100000 --fitted 20" or "--runs 5000" sets how many
	$(BIN)/python scripts/fuzz.py $(FUZZ)

axe: $(AXE)  ## fetch the checker of accessibility that the tests of pages use (npm; MPL 2.0, not part of icrtool)

$(AXE): | $(DEV)
	@mkdir -p $(@D)
	@cd $(@D) && npm pack --silent axe-core@$(AXE_VERSION) >/dev/null && tar -xzf axe-core-$(AXE_VERSION).tgz
	@echo "$(AXE_SHA256)  $(@D)/package/axe.min.js" | sha256sum --check --quiet
	@mv $(@D)/package/axe.min.js $@

bench: $(DEV)  ## speed and memory, as ratios to other tools, also in build/bench.json; BENCH=--quick takes a minute
	$(BIN)/python benchmarks/run.py --json build/bench.json $(BENCH)

bench-quick: $(DEV)
	@$(BIN)/python benchmarks/run.py --quick

unseen: $(DEV)  ## right, hedged or wrong on 120 physics drives with random sensors and troubles (an hour the first time)
	$(BIN)/python benchmarks/unseen.py --drives build/unseen-drives --cases 120

docs: $(DEV)  ## build the documentation site into build/docs
	$(BIN)/sphinx-build -q -W --keep-going -b html docs build/docs
	@echo "Pages: build/docs/index.html"

schemas: $(DEV)  ## write the JSON schemas of the documents into docs/reference/schemas, and docs/warnings.md
	$(BIN)/python scripts/schemas.py
	$(BIN)/python scripts/warning_codes.py

samples: $(DEV)  ## simulate the sample logs again
	$(BIN)/python $(SAMPLES)

wheel-check: $(DEV)
	@PYTHON=$(PYTHON) BUILD_PYTHON=$(BIN)/python scripts/check-wheel.sh

check: $(DEV)  ## everything CI runs, the built wheel included
	@$(MAKE) --no-print-directory --jobs=2 format-check lint types wheel-check bench-quick
	@$(MAKE) --no-print-directory test

# uv resolves for every platform and Python from 3.11 on, and keeps the versions already pinned where it can.
# To move one package: make constraints UPGRADE="--upgrade-package numpy"; all of them: UPGRADE=--upgrade.
COMPILE = $(BIN)/uv pip compile pyproject.toml --universal --python-version 3.11 --fork-strategy fewest \
    --generate-hashes --strip-extras --no-header --no-annotate --no-emit-index-url --no-emit-find-links --no-config --quiet
constraints: | $(BIN)/uv  ## pin the packages again, with the hash of each of their files
	@mkdir -p build
	@cat constraints.txt constraints-dev.txt >build/constraints.txt
	$(COMPILE) --all-extras $(UPGRADE) --output-file build/constraints.txt
	@sed -E -e '/^ +--hash/d' -e 's/ *\\$$//' build/constraints.txt >build/versions.txt
	$(COMPILE) --extra checkout --constraints build/versions.txt --output-file constraints.txt
	@$(BIN)/python scripts/pinned_requirements.py --rest build/constraints.txt >build/constraints-dev.txt
	@mv build/constraints-dev.txt constraints-dev.txt

$(BIN)/uv:
	@$(MAKE) --no-print-directory setup-dev

clean:  ## remove the environment, caches and builds; runs are kept
	rm -rf $(VENV) build dist .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
