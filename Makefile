# Two commands, each doing all its own set-up on a machine that has Rust, Node and make:
#   make test   everything that can be checked here; ends with one line: N passed, N failed, N skipped
#   make demo   builds the program, photographs a synthetic temple and runs the service on the pictures

.PHONY: test demo setup page clean

test: setup
	@scripts/test.sh

demo: page
	cargo build --release --locked
	target/release/multistage demo

# What the tests need besides Rust: the page's third-party code, a browser, an independent reader of COLMAP files.
setup: page web/node_modules/.package-lock.json
	@scripts/setup.sh

# The page's third-party code, bundled into static/vendor.
page: static/vendor/three.js

web/node_modules/.package-lock.json: web/package-lock.json
	cd web && npm ci --ignore-scripts --no-audit --no-fund

static/vendor/three.js: web/node_modules/.package-lock.json web/three-entry.mjs web/vendor.mjs
	cd web && npm run --silent vendor

clean:
	rm -rf target static/vendor web/node_modules .venv
