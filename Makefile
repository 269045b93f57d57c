# make demo and make test do all the set-up that they need; see make help.

# Where the environment goes, and the Python it is made from (default: the first of 3.10 to 3.12 that is found).
VENV ?= .venv
PYTHON ?=
# Arguments of the command that a target runs: make demo ARGS=--help, make test ARGS="-k mesh".
ARGS ?=
# The environment of test-newest: no pinned versions.
NEWEST_VENV ?= $(VENV)-newest

export PYTHON
# The commands and what they start find each other, whatever the caller's PATH.
activate = PATH="$(abspath $(1))/bin:$$PATH" VIRTUAL_ENV="$(abspath $(1))"

.DEFAULT_GOAL := help
.PHONY: help setup demo figures test test-newest nightly gpu-check lint site wheel format clean

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

setup: ## Make the environment (VENV=.venv), or bring it up to date
	@VENV="$(VENV)" tools/setup.sh

demo: setup ## A synthetic scene from photographs to heat flow, with pictures
	$(call activate,$(VENV)) thermoxels demo $(ARGS)

figures: setup ## Write the results in demo/ into the tables of README and docs (ARGS="--check demo" compares them)
	$(call activate,$(VENV)) python tools/figures.py $(or $(ARGS),demo)

test: setup ## Run the tests
	$(call activate,$(VENV)) OMP_NUM_THREADS=1 pytest --numprocesses logical --dist loadfile $(ARGS)

test-newest: ## Run the tests with the newest versions that pyproject.toml allows
	@VENV="$(NEWEST_VENV)" CONSTRAINTS= tools/setup.sh
	$(call activate,$(NEWEST_VENV)) OMP_NUM_THREADS=1 pytest --numprocesses logical --dist loadfile $(ARGS)

nightly: setup ## Files changed at random, 2,000 of each kind
	$(call activate,$(VENV)) NIGHTLY=1 OMP_NUM_THREADS=1 pytest --numprocesses logical tests/stability/test_files_changed_at_random.py $(ARGS)

gpu-check: setup ## On a machine with a CUDA device: its tests, and how fast steps and views are there and on the CPU
	$(call activate,$(VENV)) OMP_NUM_THREADS=1 pytest -m cuda tests/training/test_devices.py tests/data/test_datamanager.py
	$(call activate,$(VENV)) python tests/benchmarks/step_speed.py --resolutions 128 $(ARGS)

lint: setup ## Check format, style and types
	$(call activate,$(VENV)) ruff format --check .
	$(call activate,$(VENV)) ruff check .
	$(call activate,$(VENV)) PYRIGHT_PYTHON_IGNORE_WARNINGS=1 pyright --pythonpath "$(abspath $(VENV))/bin/python"

site: setup ## Build the pages of docs/ and a reference of the code into site/; a warning is an error
	$(call activate,$(VENV)) NO_MKDOCS_2_WARNING=1 mkdocs build --quiet $(ARGS)

wheel: setup ## Build wheel and sdist into dist/, install the wheel beside the packages of VENV, and try its commands
	$(call activate,$(VENV)) tools/try-wheel.sh

format: setup ## Put the code into the format that lint checks
	$(call activate,$(VENV)) ruff check --fix .
	$(call activate,$(VENV)) ruff format .

clean: ## Remove the environments and what the tests leave
	for made in "$(VENV)" "$(NEWEST_VENV)"; do if [ -e "$$made/.thermoxels-setup" ]; then rm -rf "$$made"; fi; done
	rm -rf .pytest_cache .ruff_cache .hypothesis build dist site
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
