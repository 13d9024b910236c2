#!/usr/bin/env bash
set -euo pipefail

usage() {
  cat <<'HELP'
usage: examples/integrations/security.sh DIRECTORY NAME...

Makes with openssl what DDS Security needs: a certificate authority in DIRECTORY/authority/ and, for
each participant NAME, the folder DIRECTORY/NAME/ with its certificate, its private key, what it may
do (signed) and cyclonedds.xml, the settings of Cyclone DDS. An authority that exists is used again,
so participants can be added later; a participant that exists is not replaced.

Copy DIRECTORY/NAME/ to the computer of the participant and add its file to CYCLONEDDS_URI, which
takes several, separated by commas:

  CYCLONEDDS_URI=file:///path/NAME/cyclonedds.xml ros2_node

Environment of a participant, where these places differ from those of this computer:
  DDS_SECURITY_KEYS     absolute path of its folder
  DDS_SECURITY_PLUGINS  folder of libdds_security_{auth,ac,crypto}.so of Cyclone DDS

Environment of this script:
  DAYS  validity of certificates and permissions (3650)
HELP
}

fail() {
  echo "security.sh: $1" >&2
  exit 1
}

[[ ${1-} != --help ]] || { usage && exit; }
[[ $# -ge 2 ]] || { usage >&2 && exit 2; }
command -v openssl > /dev/null || fail "openssl is missing"
days=${DAYS:-3650}
[[ $days =~ ^[1-9][0-9]{0,4}$ ]] || fail "DAYS is '$days', allowed are 1 to 99999"
directory=$(realpath -m "$1")
[[ $directory =~ ^[A-Za-z0-9_./-]+$ ]] ||
  fail "the path is '$directory', allowed are letters, digits and _ . / -"
shift
for name in "$@"; do
  [[ $name =~ ^[A-Za-z0-9_]+$ && $name != authority ]] ||
    fail "a participant is called '$name', allowed are letters, digits and _, but not 'authority'"
  [[ ! -e $directory/$name ]] || fail "$directory/$name exists"
done
umask 077  # private keys
plugins=
for folder in /usr/lib/*/libddsc0debian /opt/ros/*/lib /opt/ros/*/lib/* /usr/local/lib; do
  [[ ! -e $folder/libdds_security_auth.so ]] || { plugins=$folder && break; }
done

quietly() {
  local said
  said=$("$@" 2>&1) || fail "$said"
}
key() { quietly openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out "$1"; }

# One authority says who is who and who may do what.
authority=$directory/authority
if [[ ! -e $authority/certificate.pem ]]; then
  mkdir -p "$authority"
  key "$authority/key.pem"
  quietly openssl req -x509 -new -sha256 -key "$authority/key.pem" -days "$days" \
    -subj "/CN=authority" -out "$authority/certificate.pem"
fi
sign() {  # XML, signed file
  quietly openssl smime -sign -text -in "$1" -out "$2" \
    -signer "$authority/certificate.pem" -inkey "$authority/key.pem"
}

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/governance.xml" <<'XML'
<?xml version="1.0" encoding="UTF-8"?>
<dds>
  <domain_access_rules>
    <domain_rule>
      <domains><id_range><min>0</min><max>230</max></id_range></domains>
      <allow_unauthenticated_participants>false</allow_unauthenticated_participants>
      <enable_join_access_control>true</enable_join_access_control>
      <discovery_protection_kind>ENCRYPT</discovery_protection_kind>
      <liveliness_protection_kind>ENCRYPT</liveliness_protection_kind>
      <rtps_protection_kind>ENCRYPT</rtps_protection_kind>
      <topic_access_rules>
        <topic_rule>
          <topic_expression>*</topic_expression>
          <enable_discovery_protection>true</enable_discovery_protection>
          <enable_liveliness_protection>true</enable_liveliness_protection>
          <enable_read_access_control>true</enable_read_access_control>
          <enable_write_access_control>true</enable_write_access_control>
          <metadata_protection_kind>ENCRYPT</metadata_protection_kind>
          <data_protection_kind>ENCRYPT</data_protection_kind>
        </topic_rule>
      </topic_access_rules>
    </domain_rule>
  </domain_access_rules>
</dds>
XML
sign "$work/governance.xml" "$work/governance.p7s"

# Topics and services of ROS 2, and the topic on which its nodes find each other.
topics=
for topic in 'rt/*' 'rq/*' 'rr/*' ros_discovery_info; do topics+="<topic>$topic</topic>"; done
from=$(date -u -d '-1 day' +%Y-%m-%dT%H:%M:%SZ)
until=$(date -u -d "+$days days" +%Y-%m-%dT%H:%M:%SZ)
for name in "$@"; do
  made=$work/$name
  mkdir "$made"
  key "$made/key.pem"
  quietly openssl req -new -sha256 -key "$made/key.pem" -subj "/CN=$name" -out "$work/request.pem"
  quietly openssl x509 -req -sha256 -in "$work/request.pem" -days "$days" \
    -CA "$authority/certificate.pem" -CAkey "$authority/key.pem" \
    -set_serial "0x$(openssl rand -hex 8)" -out "$made/certificate.pem"
  cat > "$work/permissions.xml" <<XML
<?xml version="1.0" encoding="UTF-8"?>
<dds>
  <permissions>
    <grant name="$name">
      <subject_name>CN=$name</subject_name>
      <validity><not_before>$from</not_before><not_after>$until</not_after></validity>
      <allow_rule>
        <domains><id_range><min>0</min><max>230</max></id_range></domains>
        <publish><topics>$topics</topics></publish>
        <subscribe><topics>$topics</topics></subscribe>
      </allow_rule>
      <default>DENY</default>
    </grant>
  </permissions>
</dds>
XML
  sign "$work/permissions.xml" "$made/permissions.p7s"
  cp "$authority/certificate.pem" "$made/authority.pem"
  cp "$work/governance.p7s" "$made"
  keys="\${DDS_SECURITY_KEYS:-$directory/$name}"
  library="\${DDS_SECURITY_PLUGINS:-$plugins}/libdds_security"
  cat > "$made/cyclonedds.xml" <<XML
<CycloneDDS>
  <Domain Id="any">
    <Security>
      <Authentication>
        <Library path="${library}_auth.so" initFunction="init_authentication"
          finalizeFunction="finalize_authentication"/>
        <IdentityCA>file:$keys/authority.pem</IdentityCA>
        <IdentityCertificate>file:$keys/certificate.pem</IdentityCertificate>
        <PrivateKey>file:$keys/key.pem</PrivateKey>
      </Authentication>
      <AccessControl>
        <Library path="${library}_ac.so" initFunction="init_access_control"
          finalizeFunction="finalize_access_control"/>
        <PermissionsCA>file:$keys/authority.pem</PermissionsCA>
        <Governance>file:$keys/governance.p7s</Governance>
        <Permissions>file:$keys/permissions.p7s</Permissions>
      </AccessControl>
      <Cryptographic>
        <Library path="${library}_crypto.so" initFunction="init_crypto"
          finalizeFunction="finalize_crypto"/>
      </Cryptographic>
    </Security>
  </Domain>
</CycloneDDS>
XML
  mv "$made" "$directory/$name"
  echo "$name: $directory/$name/cyclonedds.xml"
done
[[ $plugins ]] || echo "no plugins of Cyclone DDS here: name their folder in DDS_SECURITY_PLUGINS"
