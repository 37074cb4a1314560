#!/usr/bin/env bash
# Runs ./dev with the arguments given in a new Debian 12: the last commit, cloned into a debootstrap chroot that holds
# nothing but the base system. Behind `./dev test --fresh`. Needs root or sudo; removes everything it made but the base
# system's archive in ${XDG_CACHE_HOME:-~/.cache}/aureole.
set -euo pipefail

suite=bookworm
self=$(realpath "${BASH_SOURCE[0]}")
top=$(dirname "$(dirname "$self")")

say() { printf '%s\n' "$*"; }
fail() {
  printf 'fresh: %s\n' "$*" >&2
  exit 1
}

# try_mount DIRECTORY ARGUMENT...: a sandbox may forbid some mounts; most of a build and its tests do without.
try_mount() {
  local directory=$1
  shift
  mkdir -p "$directory"
  mount "$@" "$directory" 2>/dev/null ||
    say "fresh: this machine does not allow to mount ${directory#"$root"}; going on without" >&2
}

# inside ROOT ARGUMENT...: mounts what a system needs and runs ./dev in it.
inside() {
  root=$1
  shift
  try_mount "$root/proc" -t proc proc
  try_mount "$root/sys" -t sysfs -o ro sysfs
  try_mount "$root/dev/pts" -t devpts -o newinstance,ptmxmode=0666,mode=620 devpts
  try_mount "$root/dev/shm" -t tmpfs -o nosuid,nodev tmpfs
  chroot "$root" /usr/bin/env -i PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
    HOME=/root LC_ALL=C.UTF-8 TERM="${TERM:-dumb}" bash -c 'cd /src/aureole && exec ./dev "$@"' dev "$@"
}

# The machine's own Debian mirror, whatever form its sources have.
mirror() {
  # shellcheck disable=SC2016
  apt-get indextargets --format '$(ORIGIN) $(COMPONENT) $(CODENAME) $(REPO_URI)' 'Created-By: Packages' |
    awk -v suite=$suite '$1 == "Debian" && $2 == "main" { if ($3 == suite) { print $4; exit } }'
}

# Makes the base system's archive when it is not there yet.
make_base() {
  local made=$work/base started=$SECONDS
  [[ -s $base ]] && return
  if ! command -v debootstrap >/dev/null; then
    say "fresh: installing debootstrap"
    { apt-get update -qq &&
      DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends debootstrap; } >"$work/log" 2>&1 ||
      { tail -n 20 "$work/log" >&2 && fail "debootstrap could not be installed"; }
  fi
  say "fresh: debootstrap $suite from $uri"
  debootstrap --variant=minbase --include=ca-certificates $suite "$made" "$uri" >"$work/log" 2>&1 ||
    { tail -n 20 "$work/log" >&2 && fail "debootstrap failed"; }
  rm -f "$made"/var/cache/apt/archives/*.deb
  mkdir -p "$(dirname "$base")"
  tar -C "$made" -czf "$base.new" .
  mv "$base.new" "$base"
  rm -rf --one-file-system "$made"
  say "fresh: base system in $((SECONDS - started)) s, kept as $base"
}

# Ends what still runs in the chroot, unmounts what is left (both only where there are no name spaces), deepest first,
# and removes it; never anything mounted.
remove_work() {
  local directory process
  [[ -z $child ]] || kill -KILL "$child" 2>/dev/null || true
  for process in /proc/[0-9]*; do
    if [[ $(readlink "$process/root" 2>/dev/null) == "$work/system" ]]; then
      kill -KILL "${process#/proc/}" 2>/dev/null || true
    fi
  done
  wait
  awk -v below="$work/" 'index($2, below) == 1 { print $2 }' /proc/self/mounts | sort -r | while read -r directory; do
    umount "$directory" 2>/dev/null || umount -l "$directory" || true
  done
  if grep -qF " $work/" /proc/self/mounts; then
    say "fresh: something is still mounted below $work; unmount and remove it by hand" >&2
  else
    rm -rf --one-file-system "$work"
  fi
}

# as_root WORK BASE ARGUMENT...: WORK holds the bundle of the commit and is removed in the end.
as_root() {
  local uri status=0
  work=$1 base=$2 child=
  shift 2
  trap remove_work EXIT
  trap 'exit 130' INT TERM HUP
  uri=$(mirror)
  [[ -n $uri ]] || fail "no source of Debian $suite in this machine's /etc/apt (has apt-get update been run?)"
  make_base
  mkdir -p "$work/system"
  tar -C "$work/system" -xzf "$base"
  say "deb $uri $suite main" >"$work/system/etc/apt/sources.list"
  cp -L /etc/resolv.conf /etc/hosts "$work/system/etc/"
  apt-config dump --format '%f "%v";%n' Acquire::http::Proxy Acquire::https::Proxy \
    >"$work/system/etc/apt/apt.conf.d/50proxy"
  mkdir -p "$work/system/src"
  git -c advice.detachedHead=false clone --quiet "$work/bundle" "$work/system/src/aureole"
  say "fresh: Debian $(<"$work/system/etc/debian_version"), commit $(git -C "$work/system/src/aureole" log -1 --format=%h)"

  # In name spaces of its own nothing stays mounted and no process stays, even after a kill.
  local spaces=(unshare --mount --pid --fork --kill-child)
  "${spaces[@]}" true 2>/dev/null || spaces=()
  "${spaces[@]}" "$self" --inside "$work/system" "$@" &
  child=$!
  wait "$child" || status=$?
  child=
  say "fresh: ./dev $*: exit code $status, $SECONDS s with the base system and the packages"
  return "$status"
}

case ${1-} in
  --inside) shift && inside "$@" ;;
  --as-root) shift && as_root "$@" ;;
  '' | -h | --help)
    sed -n '2,4s/^# //p' "$self"
    say "Usage: tests/fresh_debian.sh COMMAND [OPTION...], as for ./dev; for example: tests/fresh_debian.sh test"
    ;;
  *)
    # The bundle is made by the user whose repository it is: git refuses root another user's.
    git -C "$top" rev-parse -q --verify HEAD >/dev/null || fail "nothing is committed yet"
    [[ -z $(git -C "$top" status --porcelain) ]] || say "fresh: what is not committed is not part of it" >&2
    as=()
    if ((EUID != 0)); then
      command -v sudo >/dev/null || fail "a chroot needs root, and there is no sudo"
      as=(sudo)
    fi
    work=$(mktemp -d "${TMPDIR:-/var/tmp}/aureole-fresh.XXXXXX")
    chmod a+rx "$work"
    git -C "$top" bundle create --quiet "$work/bundle" HEAD
    exec "${as[@]}" "$self" --as-root "$work" "${XDG_CACHE_HOME:-$HOME/.cache}/aureole/$suite-$(uname -m).tar.gz" "$@"
    ;;
esac
