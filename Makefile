# Two commands: `make train` shows it work, `make test` checks it. Both set .venv up first, if needed.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python
READY := $(VENV)/.ready
TESTABLE := $(VENV)/.ready-test
PYTEST := $(RUN) -m pytest
PYTHONS := 3.10 3.11 3.12 3.13
FAST := test/test_package.py test/test_without_posix.py test/data test/objectives test/trainers/test_checkpoints.py

.PHONY: train test test-pythons slow lint docs study clean

train: $(READY)
	$(RUN) sota-implementations/ficreg/train.py $(ARGS)

test: $(TESTABLE)
	$(PYTEST) $(ARGS)

# The fast part of the tests on every Python of $(PYTHONS) that this machine has (pyenv's too), each in .venv-3.XX.
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
	$(RUN) -m flake8 torchrl_ficreg sota-implementations test
	$(RUN) -m pydocstyle torchrl_ficreg sota-implementations

docs: $(READY)
	$(VENV)/bin/pip install -q sphinx
	$(RUN) -m sphinx -q -W -b html docs/source docs/_build

# The comparison behind the table in the README: three seeds of both methods, about 50 minutes on two cores.
study: $(READY)
	PYTHON=$(RUN) sota-check/run_two_room.sh

# Everything in one call, so that pip sees all requirements at once; the marker is written only when it succeeded.
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
