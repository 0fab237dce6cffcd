#!/bin/sh
# Installs ros2-memory as services of this machine: package, user, folders, configuration, units. It can
# be run again, for an upgrade or after an interruption, and changes nothing that you changed:
#
# - A configuration, and a unit that differs from what an earlier run installed, stays. Ours is put beside
#   it as NAME.new, and named.
# - A bag directory that exists stays as it is: no owner and no mode is changed there or below.
# - No symbolic link is followed; one on the way is named, and nothing is installed.
# - No service is started, stopped or restarted.
#
# Needs sh and coreutils; for the package also Python 3.11 or newer with venv.
set -eu
umask 022

usage() {
  cat <<'END'
usage: deploy/install.sh [--query-only] [--no-package] [--topics FILE] [--root DIR]

  --query-only   the query server alone, for bags that something else records
  --no-package   leave /opt/ros2-memory/.venv as it is
  --topics FILE  the list of topics to install, instead of config/topics.yaml
  --root DIR     install the files below DIR, for an image or a test: no package, no systemctl
END
}

die() {
  printf 'install.sh: %s\n' "$1" >&2
  exit 1
}

root=
package=yes
query_only=no
topics=
while [ $# -gt 0 ]; do
  case $1 in
    --root)
      [ $# -ge 2 ] && [ -n "$2" ] || die '--root needs a folder'
      root=$2
      shift
      ;;
    --topics)
      [ $# -ge 2 ] && [ -f "$2" ] || die '--topics needs a file'
      topics=$2
      shift
      ;;
    --query-only) query_only=yes ;;
    --no-package) package=no ;;
    --help | -h)
      usage
      exit 0
      ;;
    *)
      usage >&2
      exit 2
      ;;
  esac
  shift
done

here=$(cd "$(dirname "$0")" && pwd -P)
user=ros2-memory
me=$(id -u)
if [ -n "$root" ]; then
  mkdir -p "$root"
  root=$(cd "$root" && pwd -P)
  [ "$root" != / ] || die '--root / is this machine: leave --root out'
  package=no
elif [ "$me" -ne 0 ]; then
  die 'run it as root (sudo deploy/install.sh), or with --root DIR'
fi

etc=/etc/ros2-memory
units=/etc/systemd/system
sysusers=/usr/lib/sysusers.d
installed=/usr/share/ros2-memory/installed
state=/var/lib/ros2-memory
bags=$state/bags
venv=/opt/ros2-memory/.venv
kept=

# refuse_links PATH: ends the script if PATH, or a folder on the way to it, is a symbolic link.
refuse_links() {
  way=$root
  rest=${1#/}
  while [ -n "$rest" ]; do
    way=$way/${rest%%/*}
    [ ! -L "$way" ] || die "$way is a symbolic link, which is not followed; nothing was installed"
    case $rest in
      */*) rest=${rest#*/} ;;
      *) rest= ;;
    esac
  done
}

# put FILE TO: writes TO in one step.
put() {
  [ ! -L "$2.part" ] || die "$2.part is a symbolic link, which is not followed"
  cp "$1" "$2.part"
  chmod 644 "$2.part"
  mv -f "$2.part" "$2"
}

# place FILE TO KIND: installs a file of this repository as TO. KIND is `file`, which is replaced while it
# is as an earlier run installed it, or `configuration`, which is never replaced.
place() {
  from=$here/../$1
  [ "$1" != config/topics.yaml ] || from=${topics:-$from}
  to=$root$2
  before=$root$installed/${2##*/}
  if [ -e "$to" ] && cmp -s "$from" "$to"; then
    :
  elif [ ! -e "$to" ]; then
    put "$from" "$to"
    printf 'installed %s\n' "$2"
  elif [ "$3" = file ] && [ -f "$before" ] && cmp -s "$before" "$to"; then
    put "$from" "$to"
    printf 'replaced %s, which was as installed\n' "$2"
  else
    put "$from" "$to.new"
    kept="$kept
  $2"
  fi
  put "$from" "$before"
}

# The user's and the group's number, or nothing where there is no such user.
owner() {
  if [ -z "$root" ]; then
    if id -u "$user" >/dev/null 2>&1; then
      printf '%s:%s\n' "$(id -u "$user")" "$(id -g "$user")"
    fi
  elif [ -f "$root/etc/passwd" ]; then
    while IFS=: read -r name _ uid gid _; do
      [ "$name" != "$user" ] || printf '%s:%s\n' "$uid" "$gid"
    done <"$root/etc/passwd"
  fi
}

make_user() {
  [ -z "$(owner)" ] || return 0
  if [ "$me" -ne 0 ]; then
    echo "not root: the user $user is not made, and all files are yours"
  elif command -v systemd-sysusers >/dev/null 2>&1; then
    systemd-sysusers ${root:+"--root=$root"} "$root$sysusers/$user.conf"
  elif [ -z "$root" ]; then
    useradd --system --user-group --no-create-home --home-dir "$state" --shell /usr/sbin/nologin "$user"
  else
    echo "systemd-sysusers is not here: the user $user is made when the image starts"
  fi
}

# Makes the folders that are missing, and changes none that is there. What is below a folder is made
# before that folder is given away, so nobody can put a link into the way.
make_folders() {
  as=
  [ "$me" -ne 0 ] || as=$(owner)
  mkdir -p "$root${state%/*}"
  # Only the bags are closed to others: a recorder that runs as the robot's user has to pass here.
  [ -d "$root$state" ] || mkdir -m 0755 "$root$state"
  if [ -d "$root$bags" ] || [ "$query_only" = yes ]; then
    return 0
  fi
  [ "$(stat -c %u "$root$state")" = "$me" ] ||
    die "$bags is missing and $state is not root's: make it as the user who records"
  part=$root$bags.part
  rm -rf "$part"
  mkdir -m 0750 "$part" "$part/.episodic" "$part/.episodic/requests"
  if [ -n "$as" ]; then
    chown -h "$as" "$part/.episodic/requests"
    chown -h "$as" "$part/.episodic"
    chown -h "$as" "$part"
  fi
  mv -T "$part" "$root$bags"
  printf 'made %s\n' "$bags"
}

install_package() {
  python=${PYTHON:-python3}
  [ ! -x "$venv/bin/python" ] || python=$venv/bin/python
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    die "$python is older than Python 3.11: name a newer one, PYTHON=/path/python3.11"
  if [ ! -x "$venv/bin/python" ]; then
    mkdir -p "${venv%/*}"
    "$python" -m venv "$venv"
  fi
  "$venv/bin/python" -m pip install --upgrade "$here/.."
}

if [ "$query_only" = yes ]; then
  services=ros2-memory-query
  configuration=deploy/query-environment
else
  services='ros2-memory-recorder ros2-memory-server'
  configuration='deploy/environment config/topics.yaml'
fi

# Everything is looked at before anything is written.
for path in "$venv/bin" "$bags" "$etc" "$units" "$sysusers/$user.conf" "$installed"; do
  refuse_links "$path"
done
for name in $configuration; do
  refuse_links "$etc/${name##*/}"
  refuse_links "$etc/${name##*/}.new"
done
for name in $services; do
  refuse_links "$units/$name.service"
  refuse_links "$units/$name.service.new"
done

[ "$package" = no ] || install_package
mkdir -p "$root$etc" "$root$units" "$root$sysusers" "$root$installed"
place deploy/ros2-memory.sysusers.conf "$sysusers/$user.conf" file
make_user
make_folders
for name in $configuration; do
  place "$name" "$etc/${name##*/}" configuration
done
for name in $services; do
  place "deploy/$name.service" "$units/$name.service" file
done
# Only a person says so, and only before there is a configuration that says otherwise.
if [ "$query_only" = no ] && [ -t 0 ] && cmp -s "$here/environment" "$root$etc/environment"; then
  printf 'Keep for a year where the robot drove, and what and whom it saw, after the recordings are deleted? [y/N] '
  read -r answer || answer=
  case $answer in
    y | Y | yes)
      sed 's/^\(MEMORY_CONFIG_OVERRIDES=".*\)"$/\1 memory.keep=true"/' "$here/environment" >"$root$etc/environment.part"
      chmod 644 "$root$etc/environment.part"
      mv -f "$root$etc/environment.part" "$root$etc/environment"
      ;;
  esac
fi

if [ -n "$kept" ]; then
  printf '\nThese differ from ours and stay; ours is beside each, as NAME.new:%s\n' "$kept"
fi
if [ -z "$root" ] && [ -d /run/systemd/system ]; then
  systemctl daemon-reload
  for name in $services; do
    if systemctl is-active --quiet "$name"; then
      printf '%s runs on as it was started, until: systemctl restart %s\n' "$name" "$name"
    fi
  done
fi
first=${configuration%% *}
printf '\nNext: edit %s, then: systemctl enable --now %s\n' "$etc/${first##*/}" "$services"
