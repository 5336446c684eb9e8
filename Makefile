# Two commands do everything on a machine with Python 3.11, 3.12 or 3.13:
#   make demo   set up what flying needs, then fly the demo
#   make test   set up what testing needs, then run every check and test
# Everything lives in $(VENV); `make clean` removes it. Another Python: make PYTHON=python3.12 demo

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip --disable-pip-version-check --no-input install --quiet --constraint constraints.txt

# One stamp per step: a step is repeated only when pyproject.toml or constraints.txt has changed.
MADE   := $(VENV)/.made
FLIES  := $(VENV)/.flies
TESTS  := $(VENV)/.tests
AUDIT  := $(VENV)/audit/bin/pip-audit

# Packages of the system are installed by root only, and only when they are missing.
APT     = DEBIAN_FRONTEND=noninteractive apt-get
AS_ROOT = [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null

.PHONY: help demo test bench lint audit install install-test vulkan chromium clean
.DELETE_ON_ERROR:

help:
	@echo "make demo    set up, then fly six gain sets on ANT-X and print which pass"
	@echo "make test    set up, then run all checks and tests"
	@echo "make lint    set up, then run ruff, mypy and the import contracts only"
	@echo "make bench   set up, then measure speed"
	@echo "make audit   ask which of the versions in constraints.txt have known vulnerabilities"
	@echo "make clean   remove $(VENV) and every cache; logs/ is kept"

demo: $(FLIES)
	@echo "==> flying the demo (the first flight compiles the control laws: up to half a minute)"
	@$(BIN)/froude fly

# One process more than there are processors: the tests of ground stations mostly wait.
# A temporary folder of its own: pytest clears away those of earlier runs, and fails where another pytest does so, too.
test: lint vulkan chromium
	@echo "==> tests"
	@folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && \
	  $(BIN)/python -m pytest --numprocesses="$$(( $$(nproc) + 1 ))" --dist=loadfile --no-loadscope-reorder --basetemp="$$folder/pytest"

lint: $(TESTS)
	@echo "==> ruff"
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@echo "==> mypy"
	@$(BIN)/mypy
	@echo "==> import contracts"
	@$(BIN)/lint-imports --no-logo --no-cache

bench: $(TESTS)
	@$(BIN)/python -m pytest tests/bench -o python_files='bench_*.py' --capture=no --quiet

# In an environment of its own, so that it changes nothing of what is tested. Fails, too, if nobody could be asked.
audit: $(AUDIT)
	@echo "==> asking for known vulnerabilities of the versions in constraints.txt"
	@rm -f $(VENV)/audit.json
	@$(AUDIT) --requirement constraints.txt --no-deps --disable-pip --progress-spinner off --timeout 20 \
	  --format json --output $(VENV)/audit.json >$(VENV)/audit.log 2>&1 || true
	@$(BIN)/python .ci/audit_result.py $(VENV)/audit.json $(VENV)/audit.log

install: $(FLIES)

install-test: $(TESTS)

$(MADE):
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || { \
	  echo "froude needs Python 3.11, 3.12 or 3.13; '$(PYTHON)' is $$($(PYTHON) --version 2>&1). Name another: make PYTHON=python3.11 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  { $(AS_ROOT) && echo "==> installing Debian's python3-venv" && $(APT) update -qq && \
	    $(APT) install -y -qq --no-install-recommends python3-venv >/dev/null; } || { \
	  echo "'$(PYTHON) -m venv' does not work here. As root: apt-get install python3-venv" >&2; exit 1; }; }
	@echo "==> making $(VENV)"
	@$(PYTHON) -m venv $(VENV)
	@touch $@

$(FLIES): $(MADE) pyproject.toml constraints.txt
	@echo "==> installing froude and what it flies with (numba, Rerun, Arrow and others: 1.3 GB on disk, half a minute or more)"
	@$(PIP) --editable .
	@touch $@

$(TESTS): $(FLIES)
	@echo "==> installing what the tests need (MAVSDK, MAVProxy, mypy and others: 1 GB more, a quarter of a minute or more)"
	@$(PIP) --editable '.[test]'
	@touch $@

$(AUDIT): $(MADE)
	@echo "==> installing pip-audit"
	@$(BIN)/python -m venv $(VENV)/audit
	@$(VENV)/audit/bin/python -m pip --disable-pip-version-check --no-input install --quiet pip-audit || { \
	  echo "pip-audit cannot be installed: is there a network, or a package index?" >&2; exit 2; }

# The test of the recordings' pictures draws with a software Vulkan driver. Without one it is skipped, and says so.
vulkan:
	@ls /usr/share/vulkan/icd.d/*.json /etc/vulkan/icd.d/*.json >/dev/null 2>&1 || { \
	  $(AS_ROOT) && echo "==> installing Debian's mesa-vulkan-drivers" && { \
	  { $(APT) update -qq && $(APT) install -y -qq --no-install-recommends mesa-vulkan-drivers libvulkan1 >/dev/null; } \
	    || echo "    not possible; the picture test will be skipped"; }; } || true

# The test of the report opens it in a browser. Without one it is skipped, and says so.
chromium:
	@{ command -v chromium || command -v chromium-browser || command -v google-chrome; } >/dev/null 2>&1 || { \
	  $(AS_ROOT) && echo "==> installing Debian's chromium" && { \
	  { $(APT) update -qq && $(APT) install -y -qq --no-install-recommends chromium >/dev/null; } \
	    || echo "    not possible; the test of the report in a browser will be skipped"; }; } || true

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find sitl bridge scenarios tests -name __pycache__ -type d -prune -exec rm -rf {} +
