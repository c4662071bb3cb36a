PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test install clean

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt deploy/install.sh
	PYTHON=$(PYTHON) deploy/install.sh
	touch $@

demo: install
	deploy/demo.sh

test: install
	deploy/test.sh

clean:
	rm -rf $(VENV) out run build *.egg-info
