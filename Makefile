# `make train` and `make test` set up everything they need; `make train ARGS="--domain cartpole --minutes 5"`.
# `make test-browser` tests the pages in headless Chromium, which it installs where there is none.
# `make docs` builds the documentation into build/docs.
# `make soak` fuzzes planners for long; `make soak ARGS="--checkpoint DIR"` counts missed deadlines on the wall clock.
# `make soak-faults` disturbs a run for an hour: kills, a full disk, damaged saves, NaN, failing environments.
# `make fuzz` draws thousands of examples for each property test; `make audit` asks for known vulnerabilities.

PYTHON ?= python3 python3.11 python3.12 python3.13
ARGS ?=
BIN := .venv/bin
FUZZED := $(wildcard tests/*/test_*_properties.py)
STAMP := .venv/.installed
DOCS_STAMP := .venv/.docs-installed
JAX_STAMP := .venv/.jax-installed
BROWSER_STAMP := .venv/.browser-installed

.PHONY: setup train test test-all test-browser check audit fuzz doctor bench soak soak-faults docs clean

setup: $(STAMP)

train: $(STAMP)
	@$(BIN)/python scripts/train.py --domain walker $(ARGS)

test: $(STAMP)
	$(BIN)/python -m pytest -n auto --dist loadfile

test-all: $(STAMP)
	$(BIN)/python -m pytest -n auto --dist loadfile -m "not soak and not browser"

test-browser: $(BROWSER_STAMP)
	$(BIN)/python -m pytest -m browser tests/browser $(ARGS)

check: $(JAX_STAMP) test-all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	@$(MAKE) --no-print-directory audit

audit: $(STAMP)
	@$(BIN)/python scripts/audit.py

fuzz: $(STAMP)
	$(BIN)/python -m pytest -n auto -m "" --hypothesis-profile=fuzz $(FUZZED) $(ARGS)

doctor: $(STAMP)
	@$(BIN)/python -m latentplan doctor

bench: $(STAMP)
	@$(BIN)/python scripts/benchmark.py $(ARGS)

soak: $(STAMP)
	@$(BIN)/python $(if $(ARGS),scripts/benchmark.py soak $(ARGS),-m pytest -m soak)

soak-faults: $(STAMP)
	@$(BIN)/python scripts/benchmark.py faults --minutes 60 $(ARGS)

docs: $(DOCS_STAMP)
	$(BIN)/sphinx-build -q -W --keep-going -b html docs build/docs
	@echo "open build/docs/index.html"

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache

$(STAMP): pyproject.toml constraints.txt
	@$(find_python); $(make_venv)
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[dev]'
	$(BIN)/python -m pip install --constraint constraints.txt --no-deps dm-control
	@$(install_gl)
	@touch $@

$(DOCS_STAMP): $(STAMP)
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[docs]'
	@touch $@

# Only the tests of JaxModel need jax, which is large.
$(JAX_STAMP): $(STAMP)
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[jax]'
	@touch $@

$(BROWSER_STAMP): $(STAMP)
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[browser]'
	@$(install_browser)
	@touch $@

# The first interpreter the project runs on.
define find_python
for candidate in $(PYTHON); do \
	if $$candidate -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null; \
	then python=$$candidate; break; fi; \
done; \
if [ -z "$$python" ]; then echo "no Python 3.11 to 3.13 found; name one with PYTHON=/path/to/python" >&2; exit 1; fi
endef

# Debian and Ubuntu keep the module that makes environments in a package of its own.
define make_venv
if ! $$python -c 'import ensurepip, venv' 2>/dev/null; then \
	package=$$($$python -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'); \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then apt-get update && apt-get install -y $$package; \
	else echo "Python lacks venv; run: sudo apt-get install -y $$package" >&2; exit 1; fi; \
fi; \
$$python -m venv .venv
endef

# Software rendering for machines without a display; a machine with a hardware EGL works without it.
define install_gl
missing=; \
for pair in libOSMesa.so:libosmesa6 libEGL.so:libegl1 libGL.so:libgl1; do \
	/sbin/ldconfig -p 2>/dev/null | grep -q "$${pair%%:*}" || missing="$$missing $${pair##*:}"; \
done; \
if [ -z "$$missing" ]; then :; \
elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	apt-get update || true; \
	for package in $$missing; do \
		apt-get install -y --no-install-recommends $$package || echo "could not install $$package" >&2; \
	done; \
else echo "headless rendering needs GL libraries, as many as there are;" \
	"run: for package in$$missing; do sudo apt-get install -y \$$package; done" >&2; fi
endef

# Debian has Chromium as a package; elsewhere playwright downloads its own.
define install_browser
for name in chromium chromium-browser google-chrome; do if command -v $$name >/dev/null; then exit 0; fi; done; \
if [ "$$(id -u)" = 0 ] && grep -qs '^ID=debian' /etc/os-release; then \
	apt-get update && apt-get install -y --no-install-recommends chromium; \
else $(BIN)/python -m playwright install chromium; fi
endef
