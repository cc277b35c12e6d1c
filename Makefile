# Every target does its own set-up: python3 and make are all it needs.
PYTHON ?= python3
VENV ?= .venv
PY := $(VENV)/bin/python
STAMP := $(VENV)/.installed
export SURFFOLLOW_CACHE_DIR ?= $(CURDIR)/$(VENV)/kernel-cache

.PHONY: setup demo test bench lint docs generated clean
setup: $(STAMP)

$(STAMP): requirements/dev.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(not ((3, 10) <= sys.version_info[:2] <= (3, 13)))' || \
	  { echo "surffollow needs Python 3.10 to 3.13; $$($(PYTHON) -V) found. Try: make PYTHON=python3.11 setup"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
	  { echo "Python's venv module is missing. Type: sudo apt-get install -y python3-venv"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/dev.txt
	$(PY) -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@# an activated terminal has the kernels that make compiled
	@echo 'export SURFFOLLOW_CACHE_DIR="$${SURFFOLLOW_CACHE_DIR:-$$VIRTUAL_ENV/kernel-cache}"' >> $(VENV)/bin/activate
	@touch $@

demo: $(STAMP)
	$(VENV)/bin/surffollow demo

# a hundred processes import the package: bytecode is written even where the environment says not to
test: export PYTHONDONTWRITEBYTECODE :=
test: $(STAMP)
	$(PY) tests/compile_kernels.py
	$(PY) -m pytest -n 4

bench: $(STAMP)
	$(PY) tools/bench.py

lint: $(STAMP)
	$(VENV)/bin/ruff check src tests tools docs/conf.py
	$(VENV)/bin/ruff format --check src tests tools docs/conf.py
	$(VENV)/bin/mypy
	$(VENV)/bin/mypy --config-file tests/mypy.ini
	$(PY) tools/check_prose.py
	$(PY) -m surffollow.shm.cheader --check
	$(PY) -m surffollow.arbiter.cheader --check
	$(PY) tools/protocol_tables.py --check
	$(PY) tools/write_docs.py --check

# what follows from the layouts, the parameters, the commands and the C interface
generated: $(STAMP)
	$(PY) -m surffollow.shm.cheader
	$(PY) -m surffollow.arbiter.cheader
	$(PY) tools/protocol_tables.py
	$(PY) tools/write_docs.py

# every warning is an error: a link or an anchor that leads nowhere, a docstring that cannot be read
docs: $(VENV)/.docs
	rm -rf build/site
	$(PY) -m sphinx -q -W --keep-going -b html docs build/site
	@echo "build/site/index.html"

$(VENV)/.docs: $(STAMP) pyproject.toml
	$(PY) -m pip install --quiet --disable-pip-version-check --no-build-isolation -e '.[docs]'
	@touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info src/*.egg-info
