#!/bin/sh
# Pin every third-party package with its hashes: constraints.txt (what runs) and constraints-dev.txt (tests too).
set -eu
cd "$(dirname "$0")/.."
wanted=$(mktemp -d)
trap 'rm -rf "$wanted"' EXIT
compile() {
    .venv/bin/pip-compile -q --generate-hashes --allow-unsafe --strip-extras --no-header --no-annotate \
        --no-emit-index-url --no-emit-trusted-host --no-emit-find-links "$@"
}
services="capture reconstruct judge fieldbus hmi"
# shellcheck disable=SC2086
.venv/bin/python deploy/dependencies.py --extra demo --extra build $services > "$wanted/run.in"
compile --output-file constraints.txt "$wanted/run.in"
{ cat "$wanted/run.in"; .venv/bin/python deploy/dependencies.py --dev; } > "$wanted/dev.in"
compile -c constraints.txt --output-file constraints-dev.txt "$wanted/dev.in"
