#!/bin/sh
# Fetches what the tests need besides Rust and Node. What can't be had is said plainly here; the tests that need it count
# themselves as skipped.
cd "$(dirname "$0")/.." || exit 1

# Installs a Debian package where that may be done; says else what will go without it.
install() {
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "setup: installing $1"
    { apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -y -q "$1"; } >/dev/null 2>&1 ||
      echo "setup: $1 could not be installed; $2 will be skipped"
  else
    echo "setup: no $1; install the Debian package '$1' to run $2"
  fi
}

# A browser for the page's tests.
if ! command -v chromium >/dev/null && ! command -v chromium-browser >/dev/null && ! command -v google-chrome >/dev/null; then
  install chromium "the browser tests"
fi

# Records what the program does to files, for the test of power cuts.
if ! command -v strace >/dev/null; then
  install strace "the test of power cuts"
fi

# pycolmap reads our COLMAP files, and the other packages talk to our service, independently of our code.
if ! cmp -s tests/requirements.txt .venv/ready; then
  if command -v python3 >/dev/null; then
    echo "setup: making .venv with the packages of tests/requirements.txt"
    rm -rf .venv
    { python3 -m venv .venv && .venv/bin/pip install -q --disable-pip-version-check -r tests/requirements.txt &&
      .venv/bin/python -c 'import numpy, openapi_python_client, pycolmap, pyodm, schemathesis, tusclient' && cp tests/requirements.txt .venv/ready; } ||
      echo "setup: .venv could not be made (Debian: python3-venv); checks by independent programs will be skipped"
  else
    echo "setup: no python3; checks by independent programs will be skipped"
  fi
fi
