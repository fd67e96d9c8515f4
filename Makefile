# make demo and make test do all the set-up; nothing else has to be installed first.
VENV := .venv
PYTHON := $(VENV)/bin/python
STAMP := $(VENV)/.installed
# uv if it is on the path, else venv and pip.
UV := $(shell command -v uv 2>/dev/null)
# The first Python that all wheels serve.
BASE := $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null && { echo $$p; break; }; done)

export RERUN_ANALYTICS ?= off

.PHONY: install demo test check lock clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(BASE)$(UV)" || { echo "stitch needs Python 3.11, 3.12 or 3.13: none is on the path" >&2; exit 2; }
ifdef UV
	@test -x $(PYTHON) || uv venv --quiet --python ">=3.11,<3.14" $(VENV)
	uv pip install --quiet --python $(PYTHON) --require-hashes -r constraints.txt
	uv pip install --quiet --python $(PYTHON) --no-deps --no-build-isolation -e .
else
	@test -x $(PYTHON) || $(BASE) -m venv $(VENV) || { echo "python3 has no venv module: on Debian it is in python3-venv" >&2; exit 2; }
	$(PYTHON) -m pip install --quiet --disable-pip-version-check --require-hashes -r constraints.txt
	$(PYTHON) -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
endif
	@touch $@

demo: install
	@$(VENV)/bin/stitch demo

test: install
	$(PYTHON) -m pytest

check: install
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(PYTHON) -m pytest --cov

# Pins every package with hashes; no addresses are written.
lock:
	uv pip compile pyproject.toml constraints.in --extra dev --universal --python-version 3.11 --generate-hashes \
		--no-emit-index-url --no-emit-find-links --no-annotate --no-header --quiet -o constraints.txt

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache build *.egg-info
