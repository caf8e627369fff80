#!/usr/bin/env bash
# The README's commands on a Debian that has nothing but what the README asks for: a chroot made by
# debootstrap. Needs root and debootstrap.
#
#   tools/bare_system.sh [options] FOLDER COMMAND...
#
#   tools/bare_system.sh build/bare make demo
#   tools/bare_system.sh --as user --home read-only build/bare make test
#
# FOLDER keeps the system between runs; the checkout in it is a fresh clone of HEAD each time.
#
#   --suite NAME   Debian's release: stable (default), bookworm, ...
#   --as WHO       root (default) or user
#   --home HOW     writable (default) or read-only
#   --lang LANG    C (default)
#   --python FILE  another interpreter, below a folder given with --bind
#   --bind FOLDER  a folder of this machine, readable there under the same name: an interpreter,
#                  pip's wheels or certificates. Variables PIP_* and SSL_CERT_FILE are passed on.
set -euo pipefail

suite=stable who=root home=writable lang=C python= binds=()
while [[ ${1:-} == --* ]]; do
    case $1 in
        --suite) suite=$2 ;;
        --as) who=$2 ;;
        --home) home=$2 ;;
        --lang) lang=$2 ;;
        --python) python=$2 ;;
        --bind) binds+=("$2") ;;
        *) echo "unknown option $1" >&2; exit 2 ;;
    esac
    shift 2
done
[[ $# -ge 2 ]] || { sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//p}' "$0" >&2; exit 2; }
[[ $who =~ ^(root|user)$ && $home =~ ^(writable|read-only)$ ]] || { echo "--as root or user, --home writable or read-only" >&2; exit 2; }
[[ $(id -u) = 0 ]] || { echo "a chroot needs root" >&2; exit 2; }
folder=$(realpath -m "$1")/$suite
shift

# What the README asks for, and nothing else.
packages=python3,python3-venv,make,git
if [[ ! -e $folder.made ]]; then
    mkdir -p "$folder"
    debootstrap --variant=minbase --include="$packages,ca-certificates" "$suite" "$folder" > "$folder.log"
    chroot "$folder" useradd --create-home user
    touch "$folder.made"
fi

# A mount namespace of its own: whatever happens, no mount outlives this script.
if [[ -z ${BARE_SYSTEM_MOUNTS:-} ]]; then
    options=(--suite "$suite" --as "$who" --home "$home" --lang "$lang")
    [[ -z $python ]] || options+=(--python "$python")
    for each in "${binds[@]}"; do options+=(--bind "$each"); done
    BARE_SYSTEM_MOUNTS=1 exec unshare --mount "$0" "${options[@]}" "$(dirname "$folder")" "$@"
fi
mount --bind "$folder" "$folder"
mount -t proc proc "$folder/proc"
mount --rbind /dev "$folder/dev"
mount -t tmpfs tmpfs "$folder/tmp" -o size=8g,mode=1777
for each in "${binds[@]}"; do
    mkdir -p "$folder$each"
    mount --bind "$each" "$folder$each"
    mount -o remount,bind,ro "$folder$each"
done
cp /etc/resolv.conf "$folder/etc/resolv.conf"

checkout=$(cd "$(dirname "$0")/.." && git rev-parse --show-toplevel)
rm -rf "$folder/srv/mrgs"
git clone --quiet "$checkout" "$folder/srv/mrgs"
chroot "$folder" chown -R "$who:" /srv/mrgs
at=/root && [[ $who = root ]] || at=/home/user
if [[ $home = read-only ]]; then
    mount --bind "$folder$at" "$folder$at"
    mount -o remount,bind,ro "$folder$at"
fi

passed=()
while IFS= read -r each; do passed+=("$each"); done < <(env | grep -E '^(PIP_[A-Z_]+|SSL_CERT_FILE)=' || true)
[[ -z $python ]] || passed+=("PYTHON=$python")
exec chroot --userspec="$who" "$folder" /usr/bin/env -i \
    PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME="$at" USER="$who" LANG="$lang" \
    "${passed[@]}" sh -c 'cd /srv/mrgs && exec "$@"' sh "$@"
