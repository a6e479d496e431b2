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
PIP   := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile

# Python then keeps its compiled modules: the commands that the tests run would each compile numpy and numba again.
export PYTHONDONTWRITEBYTECODE =

# Compiles what the commands load, and nothing else of a gigabyte: where Python may not write, each would compile it.
LOAD = import pkgutil, icrtool; [__import__(one.name) for one in pkgutil.walk_packages(icrtool.__path__, 'icrtool.')]

.DEFAULT_GOAL := help
AXE           = $(VENV)/axe-core/axe.min.js
AXE_VERSION   = 4.14.1
AXE_SHA256    = 29348999450cdf2849a8e70b7912fc2da85a849da39c0d0d5394f51d4a9ed95c

.PHONY: axe help setup demo format format-check lint words types test stress fuzz bench bench-quick unseen docs schemas samples wheel-check check constraints clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-13s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(READY)  ## make .venv with the pinned packages and this checkout, editable

# Hashes are checked for everything that is downloaded; this checkout then builds with the pinned hatchling.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "$(PYTHON) is Python " + sys.version.split()[0] + "; icrtool needs 3.11 or newer: make PYTHON=python3.11 ...")'
	@echo "Setting up $(VENV): about 250 MB to fetch, one to three minutes the first time."
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) --no-deps --require-hashes -r constraints.txt
	@$(PIP) --no-deps --no-build-isolation -e .
	@$(BIN)/python -c "$(LOAD)"
	@touch $@

demo: $(READY)  ## learn the ICRs of the sample robot, report its GPS dropouts, say where the plots are
	$(BIN)/icrtool fit $(DEMO_LOG) $(DEMO_OPTIONS)
	@echo
	$(BIN)/icrtool dropout-report $(DEMO_RUN)
	@echo "Plots: $(DEMO_RUN)/plots/ and $(DEMO_RUN)/dropout/plots/"

format: $(READY)  ## format the code and sort the imports
	$(BIN)/ruff format .
	$(BIN)/ruff check --select I --fix .

format-check: $(READY)
	$(BIN)/ruff format --check .

lint: $(READY)  ## ruff, and the spelling
	$(BIN)/ruff check .
	$(BIN)/codespell

words: $(READY)  ## count the words that docs/glossary.md asks to avoid, by package
	@$(BIN)/python tests/test_language.py

types: $(READY)  ## mypy, strict
	$(BIN)/mypy

# Two processes, each with whole files of tests: fixtures of a module are made once.
test: $(READY)  ## the tests, without the stress tests; JOBS=0 runs them in one process
	$(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile

stress: $(READY)  ## the long and large tests alone
	$(BIN)/python -m pytest -q -m stress

fuzz: $(READY)  ## use damaged logs, or forged runs; FUZZ="--logs 100000 --fitted 20" or "--runs 5000" sets how many
	$(BIN)/python scripts/fuzz.py $(FUZZ)

axe: $(AXE)  ## fetch the checker of accessibility that the tests of pages use (npm; MPL 2.0, not part of icrtool)

$(AXE): | $(READY)
	@mkdir -p $(@D)
	@cd $(@D) && npm pack --silent axe-core@$(AXE_VERSION) >/dev/null && tar -xzf axe-core-$(AXE_VERSION).tgz
	@echo "$(AXE_SHA256)  $(@D)/package/axe.min.js" | sha256sum --check --quiet
	@mv $(@D)/package/axe.min.js $@

bench: $(READY)  ## speed and memory, as ratios to other tools, also in build/bench.json; BENCH=--quick takes a minute
	$(BIN)/python benchmarks/run.py --json build/bench.json $(BENCH)

bench-quick: $(READY)
	@$(BIN)/python benchmarks/run.py --quick

unseen: $(READY)  ## right, hedged or wrong on 120 physics drives with random sensors and troubles (an hour the first time)
	$(BIN)/python benchmarks/unseen.py --drives build/unseen-drives --cases 120

docs: $(READY)  ## build the documentation site into build/docs
	$(BIN)/sphinx-build -q -W --keep-going -b html docs build/docs
	@echo "Pages: build/docs/index.html"

schemas: $(READY)  ## write the JSON schemas of the documents into docs/reference/schemas
	$(BIN)/python scripts/schemas.py

samples: $(READY)  ## simulate the sample logs again
	$(BIN)/python $(SAMPLES)

wheel-check: $(READY)
	@PYTHON=$(PYTHON) BUILD_PYTHON=$(BIN)/python DEMO_LOG="$(DEMO_LOG)" DEMO_OPTIONS="$(DEMO_OPTIONS)" scripts/check-wheel.sh

check: format-check lint  ## everything CI runs, the built wheel included
	@$(MAKE) --no-print-directory --jobs=2 types wheel-check bench-quick
	@$(MAKE) --no-print-directory test

# uv resolves for every platform and Python from 3.11 on, and keeps the versions already pinned where it can.
# To move one package: make constraints UPGRADE="--upgrade-package numpy"; all of them: UPGRADE=--upgrade.
constraints: | $(BIN)/uv  ## pin the packages again, with the hash of each of their files
	$(BIN)/uv pip compile pyproject.toml --all-extras --universal --python-version 3.11 --fork-strategy fewest \
	    --generate-hashes --strip-extras --no-header --no-annotate --no-emit-index-url --no-emit-find-links \
	    --no-config --quiet $(UPGRADE) --output-file constraints.txt

$(BIN)/uv:
	@$(MAKE) --no-print-directory setup

clean:  ## remove the environment, caches and builds; runs are kept
	rm -rf $(VENV) build dist .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
