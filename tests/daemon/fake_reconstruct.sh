#!/bin/sh
# In place of booth-reconstruct: does what the file "behaviour" beside it says.
recording=$1
avatar=$2
here=$(dirname "$0")
say() { printf '%s\n' "$1" >&3; }
publish() {
  partial=$(dirname "$avatar")/.partial-$(basename "$avatar").1.1
  mkdir "$partial" && printf 0123456789 >"$partial/avatar.dae" &&
    printf '{"id": "%s", "created": "2026-11-22T10:15:00Z", "recording": "%s", "triangles": 12, "warnings": ["w"],
             "files": {"avatar.dae": {}}}' "$(basename "$avatar")" "$(basename "$recording")" >"$partial/metadata.json" &&
    mv -T "$partial" "$avatar"
}
case " $* " in
  *" --learn "*)
    echo "$@" >>"$here/learned"
    exit 0
    ;;
esac
case " $* " in
  *" --growing "*)
    echo $$ >"$here/growing"
    mkdir "$(dirname "$avatar")/.partial-$(basename "$avatar").2.1"
    while read -r news; do
      echo "$news" >>"$here/news"
      case $news in
        *complete*) break ;;
        *)
          [ "$(cat "$here/behaviour")" = die_early ] && kill -SEGV $$
          ;;
      esac
    done
    case $news in *complete*) ;; *) exit 1 ;; esac
    rmdir "$(dirname "$avatar")/.partial-$(basename "$avatar").2.1"
    ;;
esac
echo "$@" >>"$here/calls"
case $(cat "$here/behaviour") in
  good | die_early)
    say '{"stage": "load", "fraction": 0.1}'
    say 'nonsense'
    say '{"stage": "hull", "fraction": 0.6}'
    say '{"stage": "export", "fraction": 0.5}'
    publish
    ;;
  good_health | moved | shifted | dark)
    for camera in b0 b1 b2 b3; do
      moved=false shifted=false light=1.02
      [ "$(cat "$here/behaviour")$camera" = movedb2 ] && moved=true
      [ "$(cat "$here/behaviour")$camera" = shiftedb1 ] && shifted=true
      [ "$(cat "$here/behaviour")" = dark ] && light=1.9
      say "{\"health\": {\"camera\": \"$camera\", \"moved\": $moved, \"offset_px\": 3.14, \"shifted\": $shifted, \
\"background_px\": 0.62, \"light_factor\": $light}}"
    done
    say '{"health": null}'
    publish
    ;;
  fail)
    say '{"error": {"kind": "no_subject", "message": "nobody is in the pictures"}}'
    exit 1
    ;;
  silent_fail)
    echo 'out of luck' >&2
    exit 3
    ;;
  crash) kill -SEGV $$ ;;
  crash_once)
    if [ -e "$here/crashed" ]; then publish; else
      : >"$here/crashed"
      kill -SEGV $$
    fi
    ;;
  nothing) exit 0 ;;
  hang)
    echo $$ >"$here/pid"
    say '{"stage": "hull", "fraction": 0.3}'
    exec sleep 1000
    ;;
  glutton) exec /usr/bin/python3 -c 'import time; taken = b"x" * (400 << 20); time.sleep(1000)' ;;
  slow)
    say '{"stage": "hull", "fraction": 0.3}'
    sleep 0.3
    publish
    ;;
esac
