# Everything runs from .venv, which is built on first use and again when it is stale.
.DEFAULT_GOAL := help
SHELL := /bin/sh

PYTHON ?= python3
ARGS ?=
LOCKED ?=
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install -q --disable-pip-version-check -c constraints.txt
STAMP := $(VENV)/.installed
TEST_STAMP := $(VENV)/.installed-test
DOCS_STAMP := $(VENV)/.installed-docs

# One intra-op thread: two threads on two busy cores are many times slower, not faster.
ONE_THREAD := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1
HEADLESS := SDL_VIDEODRIVER=dummy MPLBACKEND=Agg MUJOCO_GL=disabled WANDB_MODE=disabled
# Whatever the shell says: each of the processes of the tests would compile all modules anew.
KEEP_BYTECODE := PYTHONDONTWRITEBYTECODE=

.PHONY: help demo test lint format types config docs bench report lock clean

help: ## print these targets
	@grep -hE '^[a-z]+:.*## ' Makefile | sed -E 's/^([a-z]+):.*## /  make \1\t/' | expand -t 16
	@echo
	@echo '  PYTHON=python3.12  the interpreter for .venv (>= 3.11)'
	@echo '  ARGS="..."         more arguments for demo, test, bench'
	@echo '  LOCKED=1           install the archives of requirements.lock alone, by their digests'

demo: $(STAMP) ## learn PendulumSwingup and watch it swing up
	$(ONE_THREAD) $(BIN)/python recipes/demo.py $(ARGS)

test: $(TEST_STAMP) ## run the tests (ARGS="-m 'not slow'" for the quick ones)
	$(ONE_THREAD) $(HEADLESS) $(KEEP_BYTECODE) $(BIN)/python -m pytest -n 2 --dist worksteal $(ARGS)

lint: $(STAMP) ## ruff (lint and format) and mypy, changing nothing
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP) ## let ruff fix and format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: $(STAMP) ## mypy alone
	$(BIN)/mypy

config: $(STAMP) ## write the YAML that mirrors the dataclasses of settings
	$(BIN)/python -m phihp_torchrl.commands.mirror

docs: $(DOCS_STAMP) ## build the documentation into site/
	$(BIN)/python -m mkdocs build --strict

bench: $(STAMP) ## time the hot paths (benchmarks/speed/)
	$(ONE_THREAD) $(HEADLESS) $(BIN)/python -m pytest benchmarks/speed --benchmark-only $(ARGS)

report: $(STAMP) ## make results/report and the README's tables again from the runs that are kept
	$(PIP) -e ".[report]"
	$(ONE_THREAD) $(HEADLESS) $(BIN)/python benchmarks/paper/make_report.py any_version=true $(ARGS)
	$(ONE_THREAD) PYTHONPATH=. $(BIN)/python benchmarks/paper/six_tasks.py

lock: $(STAMP) ## write requirements.lock and sbom.json for this platform (asks the package index)
	$(BIN)/python .ci/lock.py

clean: ## remove .venv, caches and build products (results/ and outputs/ stay)
	rm -rf $(VENV) build dist site *.egg-info
	rm -rf .pytest_cache .ruff_cache .mypy_cache .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# An environment whose interpreter still runs is updated in place, so that a changed
# pyproject.toml does not pull the rug from under a running job; a broken one is replaced.
$(STAMP): pyproject.toml constraints.txt
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || { \
	  command -v "$(PYTHON)" >/dev/null 2>&1 || { \
	    echo "error: '$(PYTHON)' not found; phihp_torchrl needs Python >= 3.11:" \
	      "make PYTHON=/path/to/python3.11 ..." >&2; exit 1; }; \
	  "$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "error: phihp_torchrl needs Python >= 3.11, but '$(PYTHON)' is" \
	      "$$("$(PYTHON)" --version 2>&1); try: make PYTHON=python3.11 ..." >&2; exit 1; }; \
	  echo "Creating $(VENV) with $$("$(PYTHON)" --version)"; \
	  "$(PYTHON)" -m venv --clear $(VENV) 2>/dev/null || { \
	    "$(PYTHON)" -m venv --clear --without-pip $(VENV) && \
	    "$(PYTHON)" -m pip --python $(BIN)/python install -q pip; } || { \
	    rm -rf $(VENV); \
	    echo "error: '$(PYTHON)' can make no virtual environment with pip;" \
	      "install its venv module (Debian, Ubuntu: apt install python3-venv)" >&2; exit 1; }; \
	}
	@echo "Installing phihp_torchrl and what it needs into $(VENV) (a few minutes the first time)"
ifeq ($(LOCKED),)
	@$(PIP) torch
	@$(PIP) -e ".[dev]"
else
	@$(BIN)/python .ci/lock.py --fits
	@$(BIN)/python -m pip install -q --disable-pip-version-check --require-hashes -r requirements.lock
	@$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
endif
	@touch $@

# The worlds and launchers that tests alone need; without them those tests are skipped.
$(TEST_STAMP): $(STAMP)
ifeq ($(LOCKED),)
	@$(PIP) -e ".[dev,cluster,dmcontrol]"
endif
	@touch $@

$(DOCS_STAMP): $(STAMP)
	@$(PIP) -e ".[dev,docs]"
	@touch $@
