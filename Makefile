# Each target sets up what it needs in .venv on its first use and is quick afterwards.

PYTHON ?= python3
SEED ?= 0
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt

.PHONY: demo test check node lint docs bench bench-one-core bench-peers picture screenshot
.PHONY: results deb dist-test lock sbom vm-test clean

demo: .venv/.runtime
	$(BIN)/taxeld-hil run demo --seed $(SEED)

# A file's tests run one after another, two files side by side. TAXELD_TEST_SEED shifts every seed
test: .venv/.all
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "smoke or not check"

# The longer tests: real processes, faults, builds, experiments; and properties with fresh examples
check: .venv/.all
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "check and not smoke"
	$(BIN)/python -m pytest -n 2 --dist loadfile -m hypothesis --hypothesis-profile hunt

# What the client in JavaScript needs, for its test
node: .venv/.node

lint: .venv/.all
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/python tests/words.py
	$(BIN)/python -m taxeld_sim.answers.tables

# The documentation as a site in .venv/site; a link that leads nowhere ends it
docs: .venv/.docs
	NO_MKDOCS_2_WARNING=1 .venv/docs/bin/python -m mkdocs build

bench: .venv/.all
	$(BIN)/python benchmarks/run.py

# The same on one core of this machine, which all its processes share
bench-one-core: .venv/.all
	taskset --cpu-list 0 $(BIN)/python benchmarks/run.py

# One update beside other filters, in an environment of their own: `particles` needs an older numpy
bench-peers: .venv/.peers
	PYTHONPATH=firmware_protocol:daemon OPENBLAS_NUM_THREADS=1 .venv/peers/bin/python benchmarks/peers.py

# All questions at full size, some hours on two cores; it goes on where it was cut. ASK adds options,
# as --workers tcp://HOST:8786 or --layout skin.json
results: .venv/.all
	$(BIN)/taxeld-train evaluate $(ASK)
	$(BIN)/python -m taxeld_sim.answers.tables --write

# The notebook's pictures, of a demo's session
picture: .venv/.all
	rm -rf .venv/picture
	$(BIN)/taxeld-hil run demo --seed $(SEED) --out .venv/picture/session
	$(BIN)/python tests/pages.py examples/belief.ipynb .venv/picture

# docs/view.png, without a screen: needs Debian's xvfb, xauth and mesa-vulkan-drivers
screenshot: .venv/.all
	rm -rf .venv/screenshot
	$(BIN)/taxeld-hil run demo --seed 3 --out .venv/screenshot
	$(BIN)/taxeld view .venv/screenshot --seconds 3.1 --save .venv/screenshot/view.rrd
	xvfb-run -a -s '-screen 0 1400x900x24' $(BIN)/rerun .venv/screenshot/view.rrd \
		--hide-welcome-screen --window-size 1300x800 --screenshot-to .venv/screenshot/view.png
	$(BIN)/python -c "from PIL import Image; \
		Image.open('.venv/screenshot/view.png').convert('RGB').resize((1300, 800)) \
		.quantize(256).save('docs/view.png', optimize=True)"

# A Debian package for the Debian and the Python that it is built with (docs/service.md). WHEEL is
# what pip installs: this tree, or a wheel of it
WHEEL ?= .
deb:
	WHEEL='$(WHEEL)' PYTHON='$(PYTHON)' deploy/deb

# Wheel and source distribution, each in a clean environment
dist-test:
	PYTHON='$(PYTHON)' deploy/dist-test

# The runtime's versions (constraints.txt) with the hashes of their wheels
lock: .venv/bin/python
	$(BIN)/python deploy/lock.py >.venv/requirements.lock
	mv .venv/requirements.lock requirements.lock

# What the service is made of, as CycloneDX
sbom: .venv/.sbom
	mkdir -p dist
	.venv/sbom/bin/python -W ignore::UserWarning -m cyclonedx_py requirements requirements.lock \
		--pyproject pyproject.toml --mc-type application --output-reproducible --validate \
		--output-file dist/taxeld.cdx.json

# In a virtual machine with a Debian and a kernel of its own: needs root and Debian packages
vm-test: .venv/bin/python
	tests/vm/run

clean:
	rm -rf .venv

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/.peers: .venv/bin/python
	$(PYTHON) -m venv .venv/peers
	.venv/peers/bin/python -m pip --disable-pip-version-check install --quiet particles==0.4 pfilter==0.2.5
	touch $@

.venv/.docs: .venv/bin/python
	$(PYTHON) -m venv .venv/docs
	.venv/docs/bin/python -m pip --disable-pip-version-check install --quiet mkdocs==1.6.1 mkdocs-material==9.8.1
	touch $@

.venv/.node: .venv/bin/python examples/clients/package.json
	mkdir -p .venv/node
	cp examples/clients/package.json .venv/node
	npm install --prefix .venv/node --silent --no-audit --no-fund --no-package-lock
	touch $@

.venv/.sbom: .venv/bin/python
	$(PYTHON) -m venv .venv/sbom
	.venv/sbom/bin/python -m pip --disable-pip-version-check install --quiet cyclonedx-bom==7.5.0
	touch $@

.venv/.runtime: .venv/bin/python pyproject.toml constraints.txt hatch_build.py \
		daemon/taxeld/estimator/explain.c
	$(PIP) -e .
	touch $@

.venv/.all: .venv/.runtime
	$(PIP) -e '.[train,calibrate,view,ros2,dev,dask]'
	touch $@
