PYTHON ?= python3

.PHONY: demo test install clean

install:
	@PYTHON=$(PYTHON) deploy/install.sh

demo: install
	@deploy/demo.sh

test: install
	@deploy/test.sh

clean:
	rm -rf .venv out run build *.egg-info
