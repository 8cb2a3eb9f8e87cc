#!/bin/sh
# Fill /opt/wearline inside an image (see deploy/Dockerfile).
# usage: deploy/install.sh packages|ours SERVICE
set -eu
step=$1 service=$2
all="capture reconstruct judge fieldbus hmi"
case $service in
    capture | fieldbus | hmi | judge | reconstruct) parts=$service extras= ;;
    router) parts= extras= ;;
    plc-sim) parts=fieldbus extras= ;;
    tools) parts=$all extras="--extra demo" ;;
    *) echo "wearline: there is no image '$service'; one of $all router plc-sim tools" >&2; exit 2 ;;
esac
pip() { /build/bin/python -m pip --disable-pip-version-check --cache-dir /cache --no-input "$@"; }

packages() {
    if [ -s /run/secrets/ca ]; then
        export PIP_CERT=/run/secrets/ca
    fi
    # pip checks hashes only of what is pinned by name, so first ask it which of the pinned packages are wanted ...
    grep -oE '^[A-Za-z0-9._-]+==[^ ]+' constraints.txt > /tmp/versions.txt
    # shellcheck disable=SC2086
    python3 deploy/dependencies.py $extras $parts > /tmp/wanted.txt
    pip --python /opt/wearline/bin/python install -q --dry-run --ignore-installed --report /tmp/resolved.json \
        -r /tmp/wanted.txt -c /tmp/versions.txt
    # ... and then install those by hash, and nothing that has none.
    python3 deploy/dependencies.py --locked /tmp/resolved.json > /tmp/locked.txt
    pip --python /opt/wearline/bin/python install -q --no-compile --no-deps --only-binary :all: \
        --require-hashes -r /tmp/locked.txt
    python3 deploy/dependencies.py --locked-extra build > /tmp/build.txt
    pip install -q --no-deps --only-binary :all: --require-hashes -r /tmp/build.txt
}

ours() {
    set -- .
    for part in $parts; do set -- "$@" "services/$part"; done
    for folder in "$@"; do
        pip wheel -q --no-deps --no-build-isolation --wheel-dir /tmp/wheels "$folder"
    done
    pip --python /opt/wearline/bin/python install -q --no-compile --no-deps --no-index /tmp/wheels/*.whl
    # Third parties' tests and C headers are of no use beside a press.
    find /opt/wearline -type d \( -name tests -o -name include \) -path '*/site-packages/*' -prune -exec rm -rf {} +
    # The root file system is read-only: compiled once, here. Hashes instead of dates keep the layer reproducible.
    python3 -m compileall -q -j 0 --invalidation-mode unchecked-hash /opt/wearline/lib || true
    case $service in
        router | plc-sim) command="$service --config \"\$WEARLINE_CELL\"" ;;
        tools) command= ;;
        *) command="run $service --config \"\$WEARLINE_CELL\"" ;;
    esac
    # Any argument replaces the service's own: `docker run IMAGE --version`.
    # shellcheck disable=SC2016
    printf '#!/bin/sh\n[ $# -gt 0 ] || set -- %s\nexec /opt/wearline/bin/wearline "$@"\n' "$command" > /opt/wearline/start
    chmod 0755 /opt/wearline/start
}

case $step in
    packages | ours) "$step" ;;
    *) echo "wearline: deploy/install.sh takes 'packages' or 'ours', not '$step'" >&2; exit 2 ;;
esac
