#!/usr/bin/env bash
# k8s/rootfs.sh DIRECTORY [BIN]: what the image holds, and nothing else: the programs of BIN (default build/release/bin),
# the shared libraries that they load, and the few files that the C library asks for. No shell, no package manager.
set -euo pipefail

programs=(aureole aureole-control aureole-region)
uid=65532

top=$(dirname "$(dirname "$(realpath "${BASH_SOURCE[0]}")")")
[[ $# -ge 1 && $1 != -* ]] || { sed -n '2,3s/^# //p' "$0" && exit 2; }
root=$1 bin=${2:-$top/build/release/bin}
mkdir -p "$root"/{bin,etc}
# The process is not root, and its root file system is read-only: volumes are mounted over these two.
install -d -m 1777 "$root/data" "$root/tmp"

for program in "${programs[@]}"; do
  [[ -x $bin/$program ]] || { echo "rootfs: $bin/$program is not there (./dev build ${programs[*]})" >&2 && exit 1; }
  install -m 755 --strip "$bin/$program" "$root/bin/$program"
  # Each at the path that the loader looks for, which is also that of the loader itself.
  ldd "$bin/$program" | grep -o '/[^ ]*' | sort -u | while read -r library; do
    [[ -e $root$library ]] || install -D -m 755 "$(realpath "$library")" "$root$library"
  done
done

printf 'aureole:x:%d:%d::/:/bin/false\n' $uid $uid >"$root/etc/passwd"
printf 'aureole:x:%d:\n' $uid >"$root/etc/group"
printf 'hosts: files dns\n' >"$root/etc/nsswitch.conf"
