# Every target does its own set-up, says what it is doing, and does nothing twice. `make` alone lists them.

PYTHON ?= $(shell for python in python3 python3.11 python3.12 python3.13 python3.14; do \
	"$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2> /dev/null && echo "$$python" && break; done)
VENV := .venv/bin
ARGS ?=

# Run $(1) with everything in place; where the system packages are missing and may not be installed, run $(2) instead.
define with_images
	@tools/prepare.sh; case $$? in \
		0) $(1) ;; \
		3) $(2) ;; \
		*) exit 1 ;; \
	esac
endef

.DEFAULT_GOAL := help
.PHONY: help setup images demo test check format soak bench mutants emulator-suite lock clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-16s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: ## make the virtual environment in .venv
	@test -n '$(PYTHON)' || { echo 'setup: Python 3.11 or newer is needed; please run: sudo apt-get install python3' >&2; exit 1; }
	@$(PYTHON) tools/setup.py

images: setup ## build MicroPython for the PC and the image for the RP2040
	@tools/image/system_packages.sh && $(VENV)/python -m marotte.images all

PLAY := $(VENV)/marotte run puppets/pet.toml --score puppets/pet-score.toml --robot puppets/pet-robot.toml --arm

demo: setup ## play the pet's score on an emulated RP2040 with the real firmware
	$(call with_images, $(PLAY) --mcu rp2040 $(ARGS), $(PLAY) --mcu unix $(ARGS))

test: setup ## run the tests; ARGS='-k NAME' chooses
	$(call with_images, $(VENV)/pytest $(ARGS), MAROTTE_NO_IMAGES=1 $(VENV)/pytest $(ARGS))

check: setup ## look at the sources: ruff, mypy, and MicroPython's own compiler
	$(VENV)/ruff check .
	$(VENV)/ruff format --check host tools/*.py tests
	$(VENV)/mypy
	$(VENV)/python tools/check_firmware.py

format: setup ## bring the sources into form
	$(VENV)/ruff format host tools/*.py tests
	$(VENV)/ruff check --fix .

soak: setup ## 24 h of motion against the reference, frame by frame
	$(call with_images, $(VENV)/pytest -m soak $(ARGS), MAROTTE_NO_IMAGES=1 $(VENV)/pytest -m soak $(ARGS))

bench: setup ## what a frame costs on the emulated RP2040
	@tools/prepare.sh
	$(VENV)/python tools/bench.py $(ARGS)

mutants: setup ## plant faults in the firmware and see each one found by its test
	$(call with_images, $(VENV)/python tools/mutants.py $(ARGS), $(VENV)/python tools/mutants.py $(ARGS))

emulator-suite: setup ## run MicroPython's own test suite on the emulated RP2040
	@tools/prepare.sh
	$(VENV)/python tools/emulator_suite.py $(ARGS)

lock: setup ## write the lock files anew
	$(PYTHON) -m venv build/lock
	build/lock/bin/pip install -q --disable-pip-version-check uv
	tools/lock.sh build/lock/bin/uv

clean: ## remove what was made in the checkout; what is cached in ~/.cache/marotte stays
	rm -rf .venv build .mypy_cache .pytest_cache .ruff_cache .hypothesis host/marotte.egg-info emulator/node_modules
	find firmware host shared tests tools -name __pycache__ -type d -prune -exec rm -rf {} +
