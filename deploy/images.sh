#!/bin/sh
# Build the container images of a cell with Docker's BuildKit.
#
# usage: deploy/images.sh [--debootstrap] [IMAGE...]       all of them when none is named
#   --debootstrap   make the base debian:bookworm-slim here with debootstrap (root), for a machine that cannot pull it
#
# DOCKER               the docker client (docker)
# WEARLINE_REGISTRY    first part of the images' names (wearline)
# WEARLINE_BASE        base image, by digest if you like (debian:bookworm-slim)
# WEARLINE_CA          PEM file of a certificate authority that an inspecting proxy needs (none)
# WEARLINE_BUILD_FLAGS more flags for `docker build`, such as "--network host"
set -eu
cd "$(dirname "$0")/.."
docker=${DOCKER:-docker}
registry=${WEARLINE_REGISTRY:-wearline}
base=${WEARLINE_BASE:-debian:bookworm-slim}
version=$(sed -n 's/^version = "\(.*\)"$/\1/p' pyproject.toml | head -1)
stop() { echo "wearline: $1" >&2; exit 1; }

command -v "$docker" >/dev/null 2>&1 || stop "there is no '$docker' on this machine; install Docker, or name it with DOCKER=..."
"$docker" info >/dev/null 2>&1 || stop "no Docker engine answers; start it, or name its socket with DOCKER_HOST=unix:///..."

if [ "${1:-}" = --debootstrap ]; then
    shift
    command -v debootstrap >/dev/null 2>&1 || stop "there is no debootstrap; install it (Debian: apt install debootstrap)"
    if ! "$docker" image inspect "$base" >/dev/null 2>&1; then
        folder=$(mktemp -d)
        trap 'rm -rf "$folder"' EXIT
        debootstrap --variant=minbase --include=ca-certificates bookworm "$folder" > "$folder.log" 2>&1 ||
            stop "debootstrap failed; see $folder.log"
        rm -f "$folder.log"
        # What the slim image of Debian leaves out, too.
        rm -rf "$folder"/var/cache/apt/*.bin "$folder"/var/cache/apt/archives/*.deb "$folder"/var/lib/apt/lists/* \
            "$folder"/usr/share/doc/* "$folder"/usr/share/man/* "$folder"/usr/share/info/* \
            "$folder"/usr/share/locale/* "$folder"/var/log/*
        tar -C "$folder" -c . | "$docker" import --change 'CMD ["bash"]' - "$base" >/dev/null
    fi
fi

[ $# -gt 0 ] || set -- capture reconstruct judge fieldbus hmi router plc-sim tools prometheus
for image in "$@"; do
    case $image in
        prometheus) set -- --target prometheus ;;
        *) set -- --target service --build-arg "SERVICE=$image" ;;
    esac
    [ -z "${WEARLINE_CA:-}" ] || set -- "$@" --secret "id=ca,src=$WEARLINE_CA"
    echo "building $registry/$image:$version ..."
    # shellcheck disable=SC2086
    DOCKER_BUILDKIT=1 "$docker" build -q -f deploy/Dockerfile --build-arg "BASE=$base" ${WEARLINE_BUILD_FLAGS:-} \
        --label "org.opencontainers.image.title=wearline-$image" --label "org.opencontainers.image.version=$version" \
        -t "$registry/$image:$version" "$@" . >/dev/null || stop "the image of $image could not be built (see above)"
done
"$docker" images --format '{{.Repository}}:{{.Tag}}	{{.Size}}' | grep "^$registry/.*:$version" | sort
