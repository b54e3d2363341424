# `make quickstart` trains a small classical and a small quantum model and compares them; `make test` checks the suite.
PYTHON ?= python3
VENV ?= .venv
RUNS ?= runs
BIN := $(VENV)/bin
TORCH ?= 2.13.0

.PHONY: quickstart test test-long docs install install-dev

quickstart: install
	$(BIN)/qrlsuite run --task beam6g --model mlp --quick --epochs 5 --minutes 2 --runs $(RUNS)
	$(BIN)/qrlsuite run --task beam6g --model vqc-pennylane --quick --epochs 5 --minutes 2 --runs $(RUNS)
	$(BIN)/qrlsuite plot curves --task beam6g --entry mlp --entry vqc-pennylane --runs $(RUNS) \
	  || $(BIN)/qrlsuite plot curves --task beam6g --runs $(RUNS)  # a busy machine may not have finished an epoch of both
	$(BIN)/qrlsuite leaderboard --task beam6g --runs $(RUNS)
	@echo 'next: source $(BIN)/activate    (makes the command qrlsuite known to this terminal)'

test: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	mkdir -p $(VENV)/package/qrlsuite
	ln -sfn $(CURDIR)/qrlsuite/* $(CURDIR)/plugins $(CURDIR)/leaderboard $(CURDIR)/tasks $(VENV)/package/qrlsuite
	cd $(VENV) && MYPYPATH=package bin/mypy --config-file $(CURDIR)/pyproject.toml -p qrlsuite
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder --durations=15

# What is long by nature, before a release: CONTRIBUTING.md says what, and when it last passed.
test-long: install-dev
	$(BIN)/python -m pytest -q -m long --durations=0

# Pages from docs/ and the docstrings into site/; warnings are errors, and nothing is fetched.
docs: install-dev
	$(BIN)/pip install --quiet --no-deps --upgrade --target $(VENV)/wheel .
	QRLSUITE_DOCS_PACKAGE=$(VENV)/wheel NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

install: $(BIN)/python
	rm -f $(VENV)/editable
	$(BIN)/pip install --quiet .

install-dev: $(VENV)/editable

$(VENV)/editable: pyproject.toml | $(BIN)/python
	$(BIN)/pip install --quiet --editable '.[dev,docs]'
	touch $@

# The CPU build of torch first: a plain install would bring gigabytes of CUDA packages. With an NVIDIA GPU,
# install the torch of your choice into $(VENV) before anything else; it is kept.
$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet 'torch==$(TORCH)+cpu' 2>/dev/null \
	  || $(BIN)/pip install --quiet torch --index-url https://download.pytorch.org/whl/cpu \
	  || $(BIN)/pip install --quiet torch
