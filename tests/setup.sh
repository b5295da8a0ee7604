#!/bin/sh
# Fetches what the tests need besides Rust and Node. What can't be had is said plainly here; the tests that need it count
# themselves as skipped.
cd "$(dirname "$0")/.." || exit 1

# A browser for the page's tests.
if ! command -v chromium >/dev/null && ! command -v chromium-browser >/dev/null && ! command -v google-chrome >/dev/null; then
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "setup: installing chromium"
    { apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -y -q chromium; } >/dev/null 2>&1 ||
      echo "setup: chromium could not be installed; the browser tests will be skipped"
  else
    echo "setup: no chromium; install the Debian package 'chromium' to run the browser tests"
  fi
fi

# Records what the program does to files, for the test of power cuts.
if ! command -v strace >/dev/null; then
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "setup: installing strace"
    { apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -y -q strace; } >/dev/null 2>&1 ||
      echo "setup: strace could not be installed; the test of power cuts will be skipped"
  else
    echo "setup: no strace; install the Debian package 'strace' to run the test of power cuts"
  fi
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
