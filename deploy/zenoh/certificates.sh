#!/bin/sh
# Issue the certificates of one cell's bus: an authority (once), and one certificate each for router and services.
#
# usage: deploy/zenoh/certificates.sh CELL FOLDER [HOST...]
#   CELL    the cell's name in cell.yaml; certificates are issued to <service>.<cell>
#   FOLDER  gets authority.pem and, for each participant, <name>.pem and <name>-key.pem
#   HOST    names or addresses under which services reach the router (localhost 127.0.0.1)
#
# A folder that has an authority already keeps it, so that one authority can serve a plant; keep authority-key.pem
# off the machines of the cells. DAYS (365) is how long a certificate holds, NAMES whom one is issued to (everybody).
set -eu
stop() { echo "wearline: $1" >&2; exit 2; }
[ $# -ge 2 ] || stop "usage: certificates.sh CELL FOLDER [HOST...]"
command -v openssl >/dev/null 2>&1 || stop "there is no openssl on this machine (Debian: apt install openssl)"
cell=$1 folder=$2
shift 2
[ $# -gt 0 ] || set -- localhost 127.0.0.1
days=${DAYS:-365}
case $cell in *[!a-z0-9-]* | '') stop "cell '$cell' cannot be: small letters, digits and hyphens" ;; esac

names=
for host in "$@"; do
    case $host in
        *[!0-9.]*) names="${names:+$names,}DNS:$host" ;;
        *) names="${names:+$names,}IP:$host" ;;
    esac
done

umask 077
mkdir -p "$folder"
cd "$folder"
key() { openssl genpkey -quiet -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out "$1" 2>/dev/null ||
    openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out "$1" 2>/dev/null; }

if [ ! -f authority.pem ]; then
    key authority-key.pem
    openssl req -x509 -new -key authority-key.pem -days 3650 -subj "/CN=Wearline authority" \
        -addext "basicConstraints=critical,CA:TRUE,pathlen:0" -addext "keyUsage=critical,keyCertSign,cRLSign" \
        -out authority.pem
fi
[ -f authority-key.pem ] || stop "$folder has no authority-key.pem; bring the authority's key, or another folder"

for name in ${NAMES:-router capture reconstruct judge fieldbus hmi}; do
    key "$name-key.pem"
    openssl req -new -key "$name-key.pem" -subj "/CN=$name.$cell" -out "$name.csr"
    if [ "$name" = router ]; then use="serverAuth" names_line="subjectAltName=$names"; else
        use="clientAuth" names_line="subjectAltName=DNS:$name.$cell"; fi
    printf 'basicConstraints=critical,CA:FALSE\nkeyUsage=critical,digitalSignature\nextendedKeyUsage=%s\n%s\n' \
        "$use" "$names_line" > "$name.ext"
    openssl x509 -req -in "$name.csr" -CA authority.pem -CAkey authority-key.pem -CAcreateserial -days "$days" \
        -sha256 -extfile "$name.ext" -out "$name.pem" 2>/dev/null
    rm -f "$name.csr" "$name.ext"
done
# A service in a container runs as a user of its own; the certificates are public, the keys are not.
chmod 0755 . && chmod 0644 ./*.pem && chmod 0600 ./*-key.pem
echo "certificates of cell $cell are in $folder, valid for $days days"
