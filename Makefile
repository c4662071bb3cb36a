PYTHON ?= python3

.PHONY: demo test unit bench install manual clean

install:
	@PYTHON=$(PYTHON) deploy/install.sh

demo: install
	@deploy/demo.sh

test: install
	@deploy/test.sh

unit: install
	@.venv/bin/pytest --spread -m "not process and not sim and not sweep and not zenoh"

bench: install
	@.venv/bin/python -m bench suite

manual:
	@.venv/bin/python -m apps.cli.manual > docs/cocoro.1.new && mv docs/cocoro.1.new docs/cocoro.1
	@.venv/bin/python -m apps.cli.help_page > apps/cli/help.page.new && mv apps/cli/help.page.new apps/cli/help.page

clean:
	rm -rf .venv out run build *.egg-info
