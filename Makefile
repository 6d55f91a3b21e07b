# Each target sets up what it needs in .venv on its first use and is quick afterwards.

PYTHON ?= python3
SEED ?= 0
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt

.PHONY: demo test lint bench bench-peers picture clean

demo: .venv/.runtime
	$(BIN)/taxeld-hil run demo --seed $(SEED)

test: .venv/.all
	$(BIN)/python -m pytest

lint: .venv/.all
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python tests/import_directions.py

bench: .venv/.all
	$(BIN)/python benchmarks/run.py

# One update beside other filters, in an environment of their own: `particles` needs an older numpy
bench-peers: .venv/.peers
	PYTHONPATH=firmware_protocol:daemon OPENBLAS_NUM_THREADS=1 .venv/peers/bin/python benchmarks/peers.py

# The README's picture: the contacts of a demo session
picture: .venv/.all
	rm -rf .venv/picture
	$(BIN)/taxeld-hil run demo --seed $(SEED) --out .venv/picture
	$(BIN)/taxeld-hil draw .venv/picture --out docs/demo.png

clean:
	rm -rf .venv

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/.peers: .venv/bin/python
	$(PYTHON) -m venv .venv/peers
	.venv/peers/bin/python -m pip --disable-pip-version-check install --quiet particles==0.4 pfilter==0.2.5
	touch $@

.venv/.runtime: .venv/bin/python pyproject.toml constraints.txt
	$(PIP) -e .
	touch $@

.venv/.all: .venv/.runtime
	$(PIP) -e '.[train,view,dev,rivals,dask]'
	touch $@
