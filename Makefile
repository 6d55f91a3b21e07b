# Each target sets up what it needs in .venv on its first use and is quick afterwards.

PYTHON ?= python3
SEED ?= 0
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt

.PHONY: demo test lint bench bench-peers picture install uninstall vm-test clean

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

# The service (docs/service.md). WHEEL is what pip installs: this tree, or a wheel of it
install:
	$(PYTHON) -m venv --clear $(DESTDIR)$(LIB)
	$(DESTDIR)$(LIB)/bin/python -m pip --disable-pip-version-check install --quiet \
		-c constraints.txt $(WHEEL)
	sed -i '1s|^#!$(DESTDIR)/|#!/|' $(DESTDIR)$(LIB)/bin/taxeld*
	install -d $(DESTDIR)$(PREFIX)/bin $(DESTDIR)/etc/taxeld
	ln -sf $(LIB)/bin/taxeld $(DESTDIR)$(COMMAND)
	$(PUT) systemd/taxeld@.service $(DESTDIR)$(UNIT)
	sed -i 's|/usr/local|$(PREFIX)|' $(DESTDIR)$(UNIT)
	$(PUT) systemd/taxeld.sysusers $(DESTDIR)$(SYSUSERS)
	$(PUT) systemd/60-taxeld.rules $(DESTDIR)$(UDEV)
	$(PUT) systemd/60-can0.network $(DESTDIR)$(NETWORK)
	$(PUT) -t $(DESTDIR)$(DOC) docs/service.md examples/can0.toml
	$(if $(DESTDIR),,systemd-sysusers $(SYSUSERS))
	$(RELOAD)

# Configurations, saved states and the user stay
uninstall:
	rm -rf $(addprefix $(DESTDIR),$(LIB) $(DOC) $(UNIT) $(SYSUSERS) $(UDEV) $(NETWORK) $(COMMAND))
	-rmdir --ignore-fail-on-non-empty $(DESTDIR)/etc/taxeld
	$(RELOAD)

PREFIX ?= /usr/local
WHEEL ?= .
LIB := $(PREFIX)/lib/taxeld
DOC := $(PREFIX)/share/doc/taxeld
UNIT := $(PREFIX)/lib/systemd/system/taxeld@.service
SYSUSERS := $(PREFIX)/lib/sysusers.d/taxeld.conf
UDEV := $(PREFIX)/lib/udev/rules.d/60-taxeld.rules
NETWORK := $(PREFIX)/lib/systemd/network/60-can0.network
COMMAND := $(PREFIX)/bin/taxeld
PUT := install -D -m 644
RELOAD = $(if $(DESTDIR),,test ! -d /run/systemd/system || \
	{ systemctl daemon-reload && udevadm control --reload; })

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

.venv/.runtime: .venv/bin/python pyproject.toml constraints.txt
	$(PIP) -e .
	touch $@

.venv/.all: .venv/.runtime
	$(PIP) -e '.[train,view,dev,rivals,dask]'
	touch $@
