#!/usr/bin/env bash
# k8s/image.sh OUT.tar [NAME:TAG] [BIN]: the image of the Dockerfile's last stage as an archive for `docker load`,
# `podman load` or `ctr images import`, made without any of them from the programs of BIN (default build/release/bin).
# NAME:TAG is localhost/aureole:test when not given. The same programs give the same archive, byte for byte.
set -euo pipefail

here=$(dirname "$(realpath "${BASH_SOURCE[0]}")")
[[ $# -ge 1 && $1 != -* ]] || { sed -n '2,4s/^# //p' "$0" && exit 2; }
out=$1 name=${2:-localhost/aureole:test} bin=${3:-$(dirname "$here")/build/release/bin}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

sha256() { sha256sum "$1" | cut -d' ' -f1; }
pack() { tar --format=gnu --numeric-owner --owner=0 --group=0 --sort=name --mtime=@0 -C "$1" -cf "$2" "${@:3}"; }

"$here/rootfs.sh" "$work/root" "$bin"
mkdir "$work/image"
pack "$work/root" "$work/image/layer.tar" .

cat >"$work/config.json" <<END
{
  "architecture": "$(dpkg --print-architecture)",
  "os": "linux",
  "created": "1970-01-01T00:00:00Z",
  "config": {"User": "65532:65532", "Env": ["PATH=/bin"], "WorkingDir": "/", "Entrypoint": ["/bin/aureole"]},
  "rootfs": {"type": "layers", "diff_ids": ["sha256:$(sha256 "$work/image/layer.tar")"]},
  "history": [{"created": "1970-01-01T00:00:00Z"}]
}
END
config=$(sha256 "$work/config.json").json
mv "$work/config.json" "$work/image/$config"
printf '[{"Config": "%s", "RepoTags": ["%s"], "Layers": ["layer.tar"]}]\n' "$config" "$name" >"$work/image/manifest.json"
pack "$work/image" "$out" manifest.json "$config" layer.tar
printf 'image: %s, %s, %d kB\n' "$out" "$name" $(($(stat -c %s "$out") / 1000))
