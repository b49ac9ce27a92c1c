# make demo   build soma3 with two arms: plan, run in physics, report
# make test   linters and all tests
# make fast   the same without the slow tests
# Everything goes into .venv of this folder; the Python must be CPython 3.11.

VENV := .venv
PY := $(VENV)/bin/python
STAMP := $(VENV)/.installed
RENDERER := libegl1 libegl-mesa0 libgl1-mesa-dri
# what the tests write stays here, even where there is no home folder
export MPLCONFIGDIR ?= $(CURDIR)/.cache/matplotlib
export PYTHONDONTWRITEBYTECODE ?= 1

.PHONY: demo test fast lint setup renderer clean
.DEFAULT_GOAL := demo

demo: setup
	$(PY) scripts/run_episode.py meshes/soma/soma3.toml

test: lint
	$(PY) -m pytest -n 2 --dist loadfile -q

fast: lint
	$(PY) -m pytest -n 2 --dist loadfile -q -m "not slow"

lint: setup
	$(VENV)/bin/lint-imports
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy --ignore-missing-imports soma_bullet

setup: $(STAMP) renderer

$(STAMP): setup.cfg pyproject.toml
	@$(PY) -m pip --version >/dev/null 2>&1 || { \
	  for python in $(PYTHON) python3.11 python3 python; do \
	    if "$$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null; then \
	      echo "creating $(VENV) with $$("$$python" -c 'import sys; print(sys.executable)')"; \
	      exec "$$python" -m venv $(VENV); \
	    fi; \
	  done; \
	  echo "no CPython 3.11 found: neither python3.11, python3 nor python is one. Install it, or name it: make PYTHON=/path/to/python3.11" >&2; \
	  exit 1; }
	@echo "installing into $(VENV) (a few minutes the first time)"
	@$(PY) -m pip install --quiet --no-input --disable-pip-version-check --editable '.[test]'
	@touch $@

# PyBullet draws through EGL where there is one, and through its own software renderer where not.
renderer:
	@dpkg -s $(RENDERER) >/dev/null 2>&1 && exit 0; \
	if command -v apt-get >/dev/null; then \
	  if test "$$(id -u)" = 0; then sudo=; elif sudo -n true 2>/dev/null; then sudo="sudo -n"; else sudo=false; fi; \
	  $$sudo env DEBIAN_FRONTEND=noninteractive sh -c 'apt-get -qq update && apt-get -qq install --no-install-recommends $(RENDERER)' \
	    >/dev/null 2>&1 </dev/null && exit 0; \
	fi; \
	echo "no EGL ($(RENDERER) could not be installed): pictures will come from the software renderer"

clean:
	rm -rf build dist *.egg-info .cache .mypy_cache .pytest_cache .ruff_cache .import_linter_cache
