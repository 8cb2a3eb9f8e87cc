#!/bin/sh
# Make .venv: third-party packages by hash, then ours without dependencies. Says in one sentence what is missing.
# usage: deploy/environment.sh run|dev
set -eu
cd "$(dirname "$0")/.."
kind=$1
python=${PYTHON:-python3}

stop() { echo "wearline: $1" >&2; exit 1; }

command -v "$python" >/dev/null 2>&1 ||
    stop "there is no '$python' on this machine; install Python 3.11 or newer (Debian: apt install python3 python3-venv)"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    stop "'$python' is $("$python" -V 2>&1), Wearline needs 3.11 or newer; name another with 'make PYTHON=python3.12 ...'"
"$python" -c 'import ensurepip, venv' >/dev/null 2>&1 ||
    stop "this Python cannot make a virtual environment; install it (Debian: apt install python3-venv)"

case $kind in
    run) pins=constraints.txt ;;
    dev) pins=constraints-dev.txt ;;
    *) stop "deploy/environment.sh takes 'run' or 'dev', not '$kind'" ;;
esac

[ -x .venv/bin/python ] || "$python" -m venv .venv
echo "installing Wearline into .venv (once; a minute or two) ..."
.venv/bin/python -m pip install --disable-pip-version-check --progress-bar off -q --require-hashes -r "$pins" ||
    stop "the packages of $pins could not be installed (see above); this needs a package index once, then none"
.venv/bin/python -W ignore -m pip install --disable-pip-version-check -q --no-deps --no-build-isolation \
    -e . -e services/capture -e services/reconstruct -e services/judge -e services/fieldbus -e services/hmi
[ "$kind" = run ] || touch .venv/ready-run
touch ".venv/ready-$kind"
