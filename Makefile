# `make train` trains and evaluates a model, `make test` runs the tests. Both create .venv first, if needed.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python
READY := $(VENV)/.ready
TESTABLE := $(VENV)/.ready-test
PYTEST := $(RUN) -m pytest
PYTHONS := 3.10 3.11 3.12 3.13
FAST := test/test_package.py test/test_without_posix.py test/data test/objectives test/trainers/test_checkpoint.py

.PHONY: train test test-pythons slow lint docs study clean

train: $(READY)
	$(RUN) sota-implementations/ficreg/train.py $(ARGS)

# One process for each core, at most 4, with one thread each. In one process: make test ARGS="-n 0".
test: $(TESTABLE)
	OMP_NUM_THREADS=1 $(PYTEST) -n auto --maxprocesses 4 --dist loadfile $(ARGS)

# The fast tests on every Python of $(PYTHONS) that is installed (pyenv's too), each in its own .venv-3.XX.
test-pythons:
	@for version in $(PYTHONS); do \
		python=$$(ls -d $$(command -v python$$version) $(HOME)/.pyenv/versions/$$version.*/bin/python 2>/dev/null | tail -1); \
		if ! $${python:-false} -c '' 2>/dev/null; then echo "no Python $$version here"; continue; fi; \
		echo "Python $$version"; \
		$(MAKE) --no-print-directory PYTHON=$$python VENV=.venv-$$version test ARGS="$(FAST) $(ARGS)" || exit 1; \
	done

slow: $(TESTABLE)
	$(PYTEST) -m slow $(ARGS)

lint: $(READY)
	$(VENV)/bin/pip install -q flake8 pydocstyle
	$(RUN) -m flake8 torchrl_ficreg sota-implementations benchmarks tools test
	$(RUN) -m pydocstyle torchrl_ficreg sota-implementations benchmarks tools

docs: $(READY)
	$(VENV)/bin/pip install -q sphinx
	$(RUN) -m sphinx -q -W -b html docs/source docs/_build

# Reproduces the first table of the README: three seeds of both methods, about 50 minutes on two cores.
study: $(READY)
	PYTHON=$(RUN) sota-check/run_two_room.sh

# One call of pip, so that it resolves all requirements together; the marker is written only after success.
$(READY): pyproject.toml constraints.txt
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install -q -c constraints.txt -e '.[envs,plot,pretrained]'
	touch $@

$(TESTABLE): pyproject.toml constraints.txt
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install -q -c constraints.txt -e '.[test]'
	touch $(READY) $@

clean:
	rm -rf $(VENV)
