# Everything sets itself up: a virtual environment in .venv, filled again only when pyproject.toml or constraints.txt change.
PYTHON ?= python3
VENV ?= .venv
DEMO ?= demo-out
# one more than the cores: a test often waits for a process of its own
WORKERS ?= $(shell $(PYTHON) -c 'import os; print(min(4, (os.cpu_count() or 1) + 1))')
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt
# uv installs in an eighth of pip's time. It reads no settings of pip's: those that say where packages are get passed on
PIP_SAYS = $$($(BIN)/python -m pip config get global.$(1) 2>/dev/null)
UV = UV_FIND_LINKS="$${UV_FIND_LINKS-$${PIP_FIND_LINKS-$(call PIP_SAYS,find-links)}}" \
	UV_DEFAULT_INDEX="$${UV_DEFAULT_INDEX-$${PIP_INDEX_URL-$(call PIP_SAYS,index-url)}}" \
	UV_INDEX="$${UV_INDEX-$$PIP_EXTRA_INDEX_URL}" $(BIN)/uv pip install --quiet --python $(BIN)/python -c constraints.txt
INSTALL = { $(PIP) uv && $(UV) -e '.[$(EXTRAS)]'; } || \
	{ echo "set-up: uv could not; once more with pip, which takes minutes" >&2; $(PIP) -e '.[$(EXTRAS)]'; }
READY_DEMO := $(VENV)/.ready-demo
READY_TEST := $(VENV)/.ready-test

.DEFAULT_GOAL := help
.PHONY: help demo test check docs viewers lint format bench clean
.NOTPARALLEL:

help:  ## say what there is
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-8s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

demo: $(READY_DEMO)  ## the whole way on a made-up recording: convert, train, debias, evaluate, view (no download of data)
	@echo "demo: runs on made-up flights; everything goes to $(DEMO)"
	@$(BIN)/imutool demo --output $(DEMO) --overwrite

test: $(READY_TEST)  ## format, lint, then every test with warnings as errors, types beside them
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@echo "test: mypy --strict, and next to it viewers and pytest"
	@$(BIN)/python -m mypy & types=$$!; \
	$(BIN)/python tests/support/viewers.py || exit 1; \
	$(BIN)/python -m pytest -n $(WORKERS) --maxprocesses 4 --dist worksteal; tests=$$?; \
	wait $$types || { echo "test: mypy found what it says above" >&2; exit 1; }; exit $$tests

check: lint  ## lint, types and the tests that a change touches (BASE=commit; else what is not on origin/main yet)
	@$(BIN)/python -m pytest -q -n $(WORKERS) --maxprocesses 4 --dist worksteal $$($(BIN)/python tests/changed.py $(BASE))

docs: $(READY_TEST)  ## the documentation site, strict and without a network, into site/
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict  # with --quiet it counts no warnings
	@echo "docs: open site/index.html"

viewers: $(READY_TEST)  ## a browser and a software graphics driver for the tests that look, where apt-get may bring them
	@$(BIN)/python tests/support/viewers.py

lint: $(READY_TEST)  ## format, lint and types only
	@echo "lint: ruff format, ruff check, mypy --strict"
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/python -m mypy

format: $(READY_TEST)  ## put the source in its format
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

bench: $(READY_TEST)  ## the benchmarks of speed; those of accuracy take recordings (tests/bench)
	@set -e; for bench in tests/bench/codec.py tests/bench/train.py tests/bench/debias.py; do echo "bench: $$bench"; $(BIN)/python $$bench; done

clean:  ## remove the virtual environment, the demo and all caches
	rm -rf $(VENV) $(DEMO) build dist site .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit("imutool needs Python 3.11 or newer; this is %d.%d. Try: make PYTHON=python3.12" \
		% sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	@echo "set-up: a virtual environment in $(VENV)"
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo "on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }

$(READY_TEST): EXTRAS := dev
$(READY_TEST): pyproject.toml constraints.txt | $(BIN)/python
	@echo "set-up: imutool and what its tests need, into $(VENV) (the first time it may take minutes: torch is large)"
	@$(INSTALL)
	@touch $(READY_DEMO) $@  # what the demo needs is part of it

$(READY_DEMO): EXTRAS := train,view,report
$(READY_DEMO): pyproject.toml constraints.txt | $(BIN)/python
	@echo "set-up: imutool with viewer and report, into $(VENV) (the first time it may take minutes: torch is large)"
	@$(INSTALL)
	@touch $@
