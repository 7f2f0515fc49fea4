#!/usr/bin/env bash
# Makes the Debian package from a build folder, and installs, upgrades and purges it in a root of its own.
#
#   package_test.sh BUILD_DIR
#
# Exit status 77: it cannot be tried here, and why.
set -euo pipefail
build=$1

skip() { echo "SKIPPED: $*"; exit 77; }
fail() { echo "FAILED: $*" >&2; exit 1; }
[ "$(id -u)" -eq 0 ] || skip "only root may install packages into a root"
for program in cpack dpkg dpkg-deb dpkg-shlibdeps systemd-sysusers systemd-tmpfiles deb-systemd-helper systemctl; do
  command -v "$program" >/dev/null || skip "$program is not installed"
done

scratch=$(mktemp -d "${TMPDIR:-/tmp}/booth-package-XXXXXX")
trap 'rm -rf "$scratch"' EXIT
root=$scratch/root
mkdir -p "$scratch/out" "$root"/{etc,run,usr/{bin,lib,sbin},var/lib/dpkg/{info,updates}}
touch "$root/var/lib/dpkg/status"
for name in bin lib sbin; do ln -s "usr/$name" "$root/$name"; done

(cd "$build" && cpack -G DEB -B "$scratch/out" >"$scratch/cpack.log" 2>&1) || { cat "$scratch/cpack.log"; fail "cpack"; }
deb=$(find "$scratch/out" -maxdepth 1 -name 'avatar-booth_*.deb')
[ -f "$deb" ] || fail "no package was made"

# What is in it, and whose.
dpkg-deb -c "$deb" >"$scratch/contents"
for file in usr/bin/boothd usr/bin/boothctl usr/bin/booth-reconstruct usr/lib/systemd/system/boothd.service \
  usr/lib/udev/rules.d/70-booth.rules usr/lib/sysusers.d/booth.conf usr/lib/tmpfiles.d/booth.conf \
  usr/lib/sysctl.d/70-booth.conf etc/booth/boothd.toml usr/share/man/man1/boothctl.1.gz usr/share/man/man1/boothd.1.gz \
  usr/share/man/man1/booth-reconstruct.1.gz usr/share/man/man5/boothd.toml.5.gz \
  usr/share/bash-completion/completions/boothctl usr/share/avatar-booth/recordings/mini/recording.json \
  usr/share/avatar-booth/schema/booth-api-1.json \
  usr/lib/python3/dist-packages/avatar_booth.py usr/share/avatar-booth/conformance.py \
  usr/share/doc/avatar-booth/copyright; do
  grep -q " root/root .* \./$file$" "$scratch/contents" || fail "$file is not in the package, or not root's"
done
[ "$(dpkg-deb --ctrl-tarfile "$deb" | tar -xO ./conffiles)" = /etc/booth/boothd.toml ] || fail "conffiles"
depends=$(dpkg-deb -f "$deb" Depends)
for library in libzmq5 libaravis-0.8-0 libc6; do
  [[ $depends == *"$library"* ]] || fail "does not depend on $library: $depends"
done

install() { dpkg --root="$root" --force-depends --force-script-chrootless --force-confdef --force-confold "$@" \
  >>"$scratch/dpkg.log" 2>&1 || { cat "$scratch/dpkg.log"; fail "dpkg $*"; }; }

install -i "$deb"
grep -q '^booth:' "$root/etc/passwd" || fail "no user booth"
grep -q '^booth:' "$root/etc/group" || fail "no group booth"
[ -L "$root/etc/systemd/system/multi-user.target.wants/boothd.service" ] || fail "the service is not enabled"

# What the unit starts, with what is installed.
exec_start=$(sed -n 's/^ExecStart=//p' "$root/usr/lib/systemd/system/boothd.service")
read -ra command <<<"$exec_start"
"$root${command[0]}" "${command[1]}" "$root${command[2]}" --check || fail "the installed configuration is refused"
sed -e "s|^state_directory = .*|state_directory = \"$scratch/state\"|" -e "s|ipc:///run/booth|ipc://$scratch|" \
  -e "s|/usr/share/avatar-booth|$root&|" -e 's|^reserve_mib = [0-9]*|reserve_mib = 0|' \
  "$root${command[2]}" >"$scratch/boothd.toml"
start() {
  "$root${command[0]}" --config "$scratch/boothd.toml" 2>>"$scratch/boothd.log" &
  boothd=$!
}
# @param 1  what holds after a while
await() {
  for _ in $(seq 600); do
    if eval "$1"; then return; fi
    sleep 0.2
  done
  cat "$scratch/boothd.log"
  fail "never: $1"
}
start
ask() { "$root/usr/bin/boothctl" --control "ipc://$scratch/control" --events "ipc://$scratch/events" --timeout 60 "$@"; }
ask --json status >"$scratch/status" || { cat "$scratch/boothd.log"; fail "the installed booth does not answer"; }
grep -q '"boot"' "$scratch/status" || fail "no status"
ask shutdown
wait "$boothd" || { cat "$scratch/boothd.log"; fail "the installed booth did not end well"; }

# The operator's own settings and choices outlive an upgrade, those of an older version too.
config=$root/etc/booth/boothd.toml
sed -i '/^version = /d' "$config"
printf '[drivers]\ncamera = "replay"\n# mine\n' >>"$config"
cp "$config" "$scratch/older.toml"
systemctl --root="$root" disable --quiet boothd.service
mkdir -p "$root/var/lib/booth/avatars/somebody" "$root/etc/booth/keys/clients"
dpkg-deb -R "$deb" "$scratch/next"
sed -i 's/^Version: .*/&+1/' "$scratch/next/DEBIAN/control"
echo '# of the new version' >>"$scratch/next/etc/booth/boothd.toml"
dpkg-deb --root-owner-group -b "$scratch/next" "$scratch/next.deb" >/dev/null
# In the middle of a queue: the old program runs on while the new one is installed, and then makes room for it.
start
await 'ask capture --face none >"$scratch/first" 2>/dev/null'
await 'ask capture --face none >"$scratch/second" 2>/dev/null'
await 'ask jobs | grep -q " running "'
install -i "$scratch/next.deb"
kill "$boothd"
wait "$boothd" || { cat "$scratch/boothd.log"; fail "the old booth did not end well"; }
start
await '[ "$(ask jobs | grep -c " done ")" = 2 ]'
for id in "$scratch/first" "$scratch/second"; do
  [ "$(ask avatars list | grep -c "^$(cat "$id") ")" = 1 ] || fail "$(cat "$id") was lost in the upgrade"
done
[ "$(ask avatars list | wc -l)" = 2 ] || fail "there are other avatars than were taken"
ask shutdown
wait "$boothd" || { cat "$scratch/boothd.log"; fail "the new booth did not end well"; }
grep -qx '# mine' "$config" || fail "the operator's configuration was replaced"
cmp -s "$scratch/older.toml" "$config.bak-1" || fail "the configuration of before is not kept"
grep -qx 'version = 2' "$config" || fail "the configuration was not migrated"
"$root/usr/bin/boothd" --config "$config" --check || fail "the migrated configuration is refused"
[ -L "$root/etc/systemd/system/multi-user.target.wants/boothd.service" ] && fail "the service was enabled again"
[ -d "$root/var/lib/booth/avatars/somebody" ] || fail "an upgrade took an avatar"

install -r avatar-booth
[ ! -e "$root/usr/bin/boothd" ] || fail "the program stayed"
[ -f "$root/etc/booth/boothd.toml" ] || fail "removing took the configuration"
[ -d "$root/var/lib/booth/avatars/somebody" ] || fail "removing took an avatar"
install -P avatar-booth
for trace in var/lib/booth etc/booth usr/share/avatar-booth usr/share/doc/avatar-booth \
  etc/systemd/system/multi-user.target.wants/boothd.service etc/systemd/system/boothd.service; do
  [ ! -e "$root/$trace" ] && [ ! -L "$root/$trace" ] || fail "after purging, $trace is left"
done

if command -v lintian >/dev/null; then
  lintian --tag-display-limit 0 --fail-on error "$deb" || fail "lintian"
else
  echo "lintian is not installed: not asked"
fi
if command -v mandoc >/dev/null; then
  for page in "$build"/systemd/package/*.[15].gz; do
    zcat "$page" >"$scratch/page"
    mandoc -T lint -W error "$scratch/page" || fail "$page"
  done
fi
echo "passed"
