# `make quickstart` trains two networks and a circuit and compares them; `make test` checks the suite.
PYTHON ?= python3
VENV ?= .venv
RUNS ?= runs
BIN := $(VENV)/bin
TORCH ?= 2.13.0

.PHONY: quickstart test test-vectors test-long breaks test-lowest verify docs words tutorials site pictures statements dist demo-of-wheel install install-dev

quickstart: install
	$(BIN)/qrlsuite demo --runs $(RUNS)
	@echo 'next: source $(BIN)/activate    (makes the command qrlsuite known to this terminal)'

test: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	mkdir -p $(VENV)/package/qrlsuite
	ln -sfn $(CURDIR)/qrlsuite/* $(CURDIR)/plugins $(CURDIR)/leaderboard $(CURDIR)/tasks $(VENV)/package/qrlsuite
	cd $(VENV) && MYPYPATH=package bin/mypy --config-file $(CURDIR)/pyproject.toml -p qrlsuite
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder --durations=15
	$(MAKE) test-vectors

# Tests whose numbers are rounded by the vectors of the processor, with torch's kernels and numba's code for another one:
# by default for any, without vectors beyond the architecture's. `make test-vectors ATEN=avx2 NUMBA=haswell` is for AVX2.
ATEN ?= default
NUMBA ?= generic
VECTORS ?= tests/circuits/test_native.py tests/core/test_layers.py tests/core/test_population.py \
  tests/core/test_earlier_versions.py \
  tests/testing/test_broken_models.py::test_silu_is_refused_where_torch_rounds_it_by_place
test-vectors: install-dev
	ATEN_CPU_CAPABILITY=$(ATEN) NUMBA_CPU_NAME=$(NUMBA) NUMBA_CPU_FEATURES= $(BIN)/python -m pytest -q $(VECTORS)

# What is long by nature, before a release: CONTRIBUTING.md says what, and when it last passed.
test-long: install-dev
	$(BIN)/python -m pytest -q -m long --durations=0

# Breaks of the product, drawn once over all packages, and the test that finds each: when tests were removed.
breaks: install-dev
	$(BIN)/python tests/breaks.py

# The lowest versions that pyproject.toml allows and that have wheels for this Python, in an environment of its own: the
# tests of the commands, of what is on disk and of circuits exported to PennyLane and Qiskit. Warnings of old versions
# about each other are no errors here.
LOWEST := tests/cli/test_cli.py tests/core/test_options.py tests/core/test_parquet.py tests/core/test_store.py \
  tests/circuits/test_export.py
test-lowest:
	$(PYTHON) -m venv $(VENV)-lowest
	$(VENV)-lowest/bin/pip install --quiet uv
	$(VENV)-lowest/bin/uv pip install --quiet --python $(VENV)-lowest/bin/python --resolution lowest-direct \
	  --only-binary :all: --torch-backend cpu --editable . 'pytest>=8.2' 'hypothesis>=6.100' 'qiskit-qasm3-import>=0.6'
	$(VENV)-lowest/bin/python -m pytest -q -W default $(LOWEST) -k 'not what_comes_next'

# Published entries and studies in which this checkout differs from BASE: hashes, files, and RERUN seeds of each entry
# trained again. What they are called reaches no shell, and neither do BASE and RERUN.
BASE ?= origin/main
RERUN ?= 2
verify: export BASE := $(BASE)
verify: export RERUN := $(RERUN)
verify: install
	$(BIN)/qrlsuite verify --base "$$BASE" --rerun "$$RERUN"

# Pages from docs/ and the docstrings into site/; warnings are errors, and nothing is fetched.
docs: install-dev
	$(BIN)/pip install --quiet --no-deps --upgrade --target $(VENV)/wheel .
	QRLSUITE_DOCS_PACKAGE=$(VENV)/wheel NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Words by page: prose, tables and code apart, generated pages by themselves.
words:
	@$(PYTHON) docs/words.py

# Executes docs/tutorials in a kernel, each in a folder of its own, and stores them with their output, without timings;
# what a tutorial trains is left in a folder of the virtual environment.
tutorials: install-dev
	rm -rf $(VENV)/tutorials
	mkdir -p $(VENV)/tutorials
	cp -r docs/tutorials/*.ipynb docs/tutorials/data $(VENV)/tutorials
	cd $(VENV)/tutorials && $(abspath $(BIN))/python -c "import glob, nbclient, nbformat, os, shutil; \
	  [nbformat.write(nbclient.execute(nbformat.read(path, 4), cwd=os.path.dirname(shutil.copytree('data', path + '.runs/data')), \
	  record_timing=False, coalesce_streams=True), path) for path in sorted(glob.glob('*.ipynb'))]"
	cp $(VENV)/tutorials/*.ipynb docs/tutorials

# The documentation, and the leaderboard of published entries beside it, in one folder whose links are all checked.
site: docs
	$(BIN)/qrlsuite leaderboard --published --runs $(VENV)/no-runs --format html --out site/board.html
	$(BIN)/linkchecker --no-status --no-warnings site/index.html site/board.html

# Every picture of docs/images that shows published entries (docs/pictures.py lists all, with their commands: README's
# animation is episode.gif), the tables of published boards and studies, and their pages in docs/results.
pictures: install-dev
	$(BIN)/python docs/pictures.py
	$(BIN)/python docs/tables.py
	$(BIN)/python docs/results.py

# The table of the paper's statements, docs/statements.csv, from what is published; it takes a minute.
statements: install-dev
	$(BIN)/python docs/statements.py

# What a release publishes; and what a user gets of it, who has no clone: an empty folder and some curves.
dist: $(BIN)/python
	rm -rf dist
	$(BIN)/pip install --quiet build twine
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*
FROM_WHEEL := cd $(VENV)-wheel/elsewhere && exec ../bin/qrlsuite
demo-of-wheel: dist
	$(MAKE) $(VENV)-wheel/bin/python VENV=$(VENV)-wheel
	$(VENV)-wheel/bin/pip install --quiet --force-reinstall --no-deps dist/*.whl
	$(VENV)-wheel/bin/pip install --quiet dist/*.whl
	rm -rf $(VENV)-wheel/elsewhere
	mkdir $(VENV)-wheel/elsewhere
	cp docs/tutorials/data/racetraq_chicane_4q.csv $(VENV)-wheel/elsewhere/curves.csv
	$(FROM_WHEEL) demo
	$(FROM_WHEEL) import curves.csv metric=lapped_share maximum=1
	$(FROM_WHEEL) leaderboard --published --task beam6g
	$(FROM_WHEEL) run --task beam6g --model vqc-pennylane --quick
	$(FROM_WHEEL) view --port 8765 & \
	  curl --silent --fail --retry 60 --retry-delay 1 --retry-connrefused --output /dev/null http://127.0.0.1:8765; \
	  shown=$$?; kill $$!; exit $$shown

# By uv, which takes a sixth of pip's processor time and shows what it downloads; by pip where uv does not find all of it:
# it does not read pip's settings, an index of your own for example.
UV := $(BIN)/uv pip install --python $(BIN)/python

install: $(BIN)/python
	rm -f $(VENV)/editable
	@echo 'installing qrlsuite and what it needs: 60 packages, a download of 270 MB; 2 GB in all'
	$(UV) . || $(BIN)/pip install .

install-dev: $(VENV)/editable

$(VENV)/editable: pyproject.toml | $(BIN)/python
	@echo 'installing qrlsuite, what it needs and what its tests need'
	$(UV) --editable '.[dev,docs]' || $(BIN)/pip install --editable '.[dev,docs]'
	touch $@

# The CPU build of torch first: a plain install would bring gigabytes of CUDA packages. With an NVIDIA GPU,
# install the torch of your choice into $(VENV) before anything else; it is kept.
$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet uv
	@echo 'installing torch into $(VENV): a download of 200 MB'
	$(BIN)/pip install 'torch==$(TORCH)+cpu' 2>/dev/null || $(UV) --torch-backend cpu torch || $(BIN)/pip install torch
