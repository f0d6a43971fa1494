# Each target makes its own environment in .venv when there is none.
#   make demo      skin the sample head, print the scores, write demo/
#   make test      all tests, every notebook, the examples in the docstrings
#   make lab       JupyterLab at notebook 00
#   make refresh   execute and normalise all notebooks, in place
#   make lint      check and format
#   make bench     measure again what benchmarks/ reports

PYTHON ?= python3
VENV ?= .venv
JOBS ?= 2
bin := $(VENV)/bin

# Idle OpenMP threads that spin take the cores from the threads that work.
export OMP_WAIT_POLICY := PASSIVE
export GOMP_SPINCOUNT := 0
# The debugger's remark about frozen modules is noise in every notebook.
export PYDEVD_DISABLE_FILE_VALIDATION := 1

.PHONY: demo test lab refresh lint bench clean
.DEFAULT_GOAL := demo

demo: $(VENV)/installed
	$(bin)/skinlib demo

# One thread a worker: two workers that each take all cores slow each other down.
test: export OMP_NUM_THREADS := 1
test: $(VENV)/installed
	$(bin)/python -m pytest -n $(JOBS) --dist loadfile $(PYTEST_ARGS)

lab: $(VENV)/installed
	$(bin)/jupyter lab notebooks/00_quickstart.ipynb

refresh: export OMP_NUM_THREADS := 1
refresh: $(VENV)/installed
	$(bin)/python scripts/refresh_notebooks.py $(NOTEBOOKS)

lint: $(VENV)/installed
	$(bin)/ruff check --fix
	$(bin)/ruff format

# The accuracy numbers need heads and half an hour: see benchmarks/README.md.
bench: $(VENV)/installed
	set -e; for name in edgeconv adversarial_step skin_speed speed scaling; do \
	  echo "== $$name"; $(bin)/python benchmarks/$$name.py; done

clean:
	rm -rf $(VENV) demo

# torch goes first: asked for by its exact version, a CPU build on your disk or your
# index is taken, where a range would let pip prefer a newer and much larger one.
$(VENV)/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "skinlib needs Python 3.11 or newer: make PYTHON=python3.12 ..."; exit 1; }
	test -x $(bin)/pip || $(PYTHON) -m venv $(VENV)
	$(bin)/python -m pip install "$$(grep '^torch==' constraints.txt)" -c constraints.txt
	$(bin)/python -m pip install -e '.[dev]' -c constraints.txt
	touch $@
