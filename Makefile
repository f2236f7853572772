# `make demo`, `make test` and `make lint` each set up what they need: a virtual environment in .venv that holds this
# package, editable, and the exact versions of constraints.txt. Nothing is installed outside this folder.

PYTHON ?= python3
PYTEST_ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

# One thread per process: OpenMP's threads spin while they wait and slow each other down when the cores are shared.
export OMP_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help install demo docs docs-links wheel test fault-test mutation-test lint clean

help:
	@echo "make install   set up .venv with the package and everything its development needs"
	@echo "make demo      train on ModCartPole-v0 for a few minutes; results in demo/"
	@echo "make docs      the documentation as a site, in build/docs; a warning is an error"
	@echo "make docs-links  are the links to other sites alive? (needs the network)"
	@echo "make wheel     a wheel with compiled code for this system, in dist/"
	@echo "make test      lint and docs, then the tests (PYTEST_ARGS=... for pytest)"
	@echo "make fault-test  kill, cut, mutate and soak in full, for more than half an hour; table in benchmarks/results/"
	@echo "make mutation-test  change the code in many places, one at a time, and see whether a test fails: hours"
	@echo "make lint      ruff and mypy"
	@echo "make clean     remove .venv, caches and demo/"
	@echo "PYTHON=python3.12 make ... chooses the interpreter that .venv is made with (default: python3)"

install: $(INSTALLED)

# Most modules of what is installed are never imported; Python compiles the others when they are.
$(INSTALLED): pyproject.toml constraints.txt
	@if ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
	  command -v $(PYTHON) >/dev/null || \
	    { echo "error: $(PYTHON) was not found; install Python 3.10 or newer, or say PYTHON=/path/to/python3 make ..."; exit 1; }; \
	  $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	    { echo "error: Python 3.10 or newer is needed, but $(PYTHON) is $$($(PYTHON) --version 2>&1); say PYTHON=python3.12 make ..."; exit 1; }; \
	  $(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	    { echo "error: $(PYTHON) cannot make virtual environments; on Debian or Ubuntu: apt-get install python3-venv"; exit 1; }; \
	  $(PYTHON) -m venv --clear $(VENV); \
	fi
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-compile --constraint constraints.txt --editable '.[all]'
	@touch $@

# The defaults, with fewer candidates than the paper has.
demo: $(INSTALLED)
	$(BIN)/dgpmpc train ModCartPole-v0 --layers 2 --episodes 6 --seed 0 --out demo --candidates 200

wheel: $(INSTALLED)
	GYM_DGPMPC_COMPILE=1 $(BIN)/python -m pip wheel --disable-pip-version-check --quiet --no-deps --wheel-dir dist .
	@ls dist/*.whl

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# All pages are read anew each time: of a page that has not changed Sphinx would keep its warnings to itself.
SPHINX = $(BIN)/python -m sphinx -c docs -d build/doctrees -E -q -W --keep-going

docs: $(INSTALLED)
	$(SPHINX) -b html . build/docs
	@echo "the site begins at build/docs/index.html"

docs-links: $(INSTALLED)
	$(SPHINX) -b linkcheck . build/links

# MuJoCo draws off-screen through EGL or OSMesa, whichever works here; with neither, the tests of rendering skip.
# Lint and docs beside each other, for each is of one thread.
test: $(INSTALLED)
	@$(MAKE) --no-print-directory -j2 lint docs
	@gl=$${MUJOCO_GL:-$$($(BIN)/python -m gym_dgpmpc.runs.rendering)}; \
	echo "MUJOCO_GL=$$gl"; \
	MUJOCO_GL=$$gl $(BIN)/python -m pytest -n 2 $(PYTEST_ARGS)

# The full form of tests/faults, two sections at a time; `make test` runs a short form.
fault-test: $(INSTALLED)
	$(BIN)/python -m tests.faults

# How many mutants of each package; 0: all of them.
MUTANTS ?= 0

# What was tried before is not tried again. docs/mutation.md has the results; it needs Python 3.11.
mutation-test: $(INSTALLED)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --constraint constraints.txt --editable '.[mutation]'
	test -e build/mutation/map.json || $(BIN)/python -m tests.mutation map
	$(BIN)/python -m tests.mutation run --sample $(MUTANTS)
	$(BIN)/python -m tests.mutation report --sample $(MUTANTS)

clean:
	rm -rf $(VENV) demo build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
