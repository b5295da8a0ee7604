# Two commands, each doing all its own set-up on a machine that has Rust, Node and make:
#   make test   everything that can be checked here; ends with one line: N passed, N failed, N skipped
#   make demo   builds the program, photographs a synthetic temple and runs the service on the pictures

.PHONY: test demo setup page clean

test: setup
	@tests/run.sh

demo: page
	cargo build --release --locked
	target/release/multistage demo

# What the tests need besides Rust: the page's third-party code, a browser and what drives it, an independent reader of COLMAP files.
setup: page tests/page/node_modules/.package-lock.json
	@tests/setup.sh

# The page's third-party code, bundled into static/vendor.
page: static/vendor/three.js

static/vendor/three.js: static/node_modules/.package-lock.json static/three-entry.mjs static/tus-entry.mjs static/vendor.mjs
	cd static && npm run --silent vendor

%/node_modules/.package-lock.json: %/package-lock.json
	cd $* && npm ci --ignore-scripts --no-audit --no-fund

clean:
	rm -rf target static/vendor static/node_modules tests/page/node_modules .venv
