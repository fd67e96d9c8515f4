# make demo and make test do all the set-up; nothing else has to be installed first.
VENV := .venv
PYTHON := $(VENV)/bin/python
STAMP := $(VENV)/.installed
# uv if it is on the path, else venv and pip.
UV := $(shell command -v uv 2>/dev/null)
RANGE := >=3.11,<3.14
# True for a Python that all wheels serve.
SERVES := -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' >/dev/null 2>&1
BASE := $(shell for p in python3 python3.13 python3.12 python3.11; do $$p $(SERVES) && { echo $$p; break; }; done)
# What only the system can bring is installed where that asks nobody: for root, with apt.
ROOT_APT := test "$$(id -u)" = 0 && command -v apt-get >/dev/null && apt-get update -q
PIP := $(PYTHON) -m pip --quiet --disable-pip-version-check
# Open3D has no wheel for a Linux whose C library is older than 2.35, or another: there it is left out of what is pinned,
# and where one that is not ours can be imported: open3d-cpu would write over its files.
NO_OPEN3D := import os, sys; from importlib import metadata, util; sys.exit(not (sys.platform == "linux" and \
	[int(n) for n in (os.confstr("CS_GNU_LIBC_VERSION") or "no 0.0").split()[1].split(".")] < [2, 35] or \
	util.find_spec("open3d") and not any(d.name == "open3d-cpu" for d in metadata.distributions())))
PINNED := $(VENV)/constraints.txt
PIN := { $(PYTHON) -c '$(NO_OPEN3D)' && sed '/^open3d/,/[^\]$$/d' constraints.txt || cat constraints.txt; } >$(PINNED)
# What Open3D lacks of the system: packages to standard output, a sentence to standard error.
LACKING := $(PYTHON) -m stitch.system.open3d_library

# What stitch-scans was called in environments made before; of two that hold the same modules none would be whole.
FORMER := stitch

export RERUN_ANALYTICS ?= off

.PHONY: install demo test lint check docs lock clean

install: $(STAMP)

# A .venv that an interrupted or failed attempt left behind is made anew.
$(STAMP): pyproject.toml constraints.txt
	@echo "setting up $(VENV): 2.3 GB of packages, the first time some minutes" >&2
ifdef UV
	@$(PYTHON) $(SERVES) || uv venv --quiet --clear --python "$(or $(BASE),$(RANGE))" $(VENV) || \
		{ echo "stitch needs Python 3.11, 3.12 or 3.13: none was found" >&2; exit 2; }
	@$(PIN)
	uv pip install --quiet --compile-bytecode --python $(PYTHON) --require-hashes -r $(PINNED)
	@uv pip uninstall --quiet --python $(PYTHON) $(FORMER) 2>/dev/null || true
	uv pip install --quiet --python $(PYTHON) --no-deps --no-build-isolation -e .
else
	@test -n "$(BASE)" || { echo "stitch needs Python 3.11, 3.12 or 3.13: none is on the path; on Debian 12 or \
	Ubuntu 24.04: apt-get install python3-venv" >&2; exit 2; }
	@$(BASE) -c 'import ensurepip' 2>/dev/null || { $(ROOT_APT) && apt-get install -y -q $(BASE)-venv; } || \
		{ echo "$(BASE) has no venv module: apt-get install $(BASE)-venv" >&2; exit 2; }
	@{ $(PYTHON) $(SERVES) && $(PIP) --version >/dev/null 2>&1; } || $(BASE) -m venv --clear $(VENV)
	@$(PIN)
	$(PIP) install --require-hashes -r $(PINNED)
	@$(PIP) uninstall --yes $(FORMER) 2>/dev/null || true
	$(PIP) install --no-deps --no-build-isolation -e .
endif
	@lacking=$$($(LACKING) 2>/dev/null); test -z "$$lacking" || { $(ROOT_APT) && \
		DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends $$lacking; } >/dev/null 2>&1 || true
	@$(LACKING) >/dev/null
	@touch $@

demo: install
	@$(VENV)/bin/stitch demo

# Programs that the tests start would compile stitch anew where nothing may be kept.
test: export PYTHONDONTWRITEBYTECODE =
test: install
	$(PYTHON) -m pytest

# Style, format, types, which room may import which, how large each part may be, and licences of what it brings.
lint: install
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports --no-logo
	$(PYTHON) bench/budget.py
	$(PYTHON) bench/licences.py

check: lint docs
	$(PYTHON) -m pytest -m "slow or not slow" --cov
	@$(VENV)/bin/coverage report --include='stitch/*' --format=total --fail-under=93

# The pages as a site in build/site, which needs no server: open index.html. A warning or a dead link ends it.
docs: install
ifdef UV
	uv pip install --quiet --python $(PYTHON) --require-hashes -r constraints.txt -r constraints-docs.txt
else
	$(PIP) install --require-hashes -r constraints.txt -r constraints-docs.txt
endif
	$(PYTHON) -m bench.docs.site_pages
	$(VENV)/bin/zensical build --clean --strict --config-file mkdocs.yml

# Pins every package with hashes, with its extras: pip takes the newest of a package whose extra alone is asked for, and
# finds no hash for it. What other indexes or settings of this machine might write into it is refused.
lock:
	@command -v uv >/dev/null || { echo "make lock needs uv" >&2; exit 2; }
	uv pip compile pyproject.toml constraints.in --extra dev --extra open3d --universal --python-version 3.11 --generate-hashes \
		--no-strip-extras --no-emit-index-url --no-emit-find-links --no-annotate --no-header --quiet -o constraints.txt
	uv pip compile pyproject.toml --extra docs --universal --python-version 3.11 --generate-hashes --constraint constraints.txt \
		$$(sed -nE 's/^([a-z0-9-]+)(\[.*\])?==.*/--no-emit-package \1/p' constraints.txt) \
		--no-emit-index-url --no-emit-find-links --no-annotate --no-header --quiet -o constraints-docs.txt
	@! grep -nE '://| @ |^-' constraints.txt constraints-docs.txt || { echo "they name an address" >&2; exit 1; }

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .coverage .cache build *.egg-info
