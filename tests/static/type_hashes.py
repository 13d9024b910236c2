"""type_hashes.py IDL_DIR COMPILER MESSAGES_HPP: the hashes of types in messages.hpp are those of ROS 2.

Computes the hash of every type in IDL_DIR as REP 2016 defines it (RIHS01): SHA-256 of a JSON text of
its fields and of the types that they refer to. Prints those that MESSAGES_HPP lacks."""
import glob
import hashlib
import json
import re
import subprocess
import sys

# Hashes as ROS 2 has them.
KNOWN = {
    "builtin_interfaces/msg/Time": "b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197",
    "geometry_msgs/msg/Pose": "d501954e9476cea2996984e812054b68026ae0bfae789d9a10b23daf35cc90fa",
    "rosgraph_msgs/msg/Clock": "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564",
    "std_msgs/msg/Header": "f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01",
}
# FieldType.msg of type_description_interfaces.
IDS = {"int8": 2, "uint8": 3, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8,
       "uint64": 9, "float": 10, "double": 11, "boolean": 15, "octet": 16, "string": 17}
NESTED, ARRAY, SEQUENCE = 1, 48, 144


def read(folder, compiler):
    """{name in IDL: [(field, type, size of an array or None)]} of all structs."""
    structs = {}
    for file in glob.glob(folder + "/*.idl"):
        text = subprocess.run([compiler, "-E", "-P", "-x", "c", "-I", folder, file], check=True,
                              capture_output=True, text=True).stdout
        scope = []
        for part in re.finditer(r"module (\w+)\s*\{|struct (\w+)\s*\{(.*?)\}\s*;|\}\s*;", text, re.S):
            module, struct, body = part.groups()
            if module:
                scope.append(module)
            elif struct:
                fields = [" ".join(field.split()) for field in body.split(";")]
                structs["::".join(scope + [struct])] = [
                    re.fullmatch(r"(.+?) (\w+)(?:\[(\d+)\])?", field).group(2, 1, 3)
                    for field in fields if field]
            else:
                scope.pop()
    return structs


def ros_name(name):
    """An older version has the name of the current one."""
    return name.split("::")[0] + "/msg/" + re.sub(r"(V\d+)?_$", "", name.split("::")[-1])


def find(structs, name, user):
    """The struct that `user` means with `name`."""
    scope = user.split("::")[:-1]
    while "::".join(scope + [name]) not in structs:
        scope.pop()
    return "::".join(scope + [name])


def described(structs, name):
    """The description of a struct, and the structs that it refers to."""
    fields, others = [], set()
    for field, kind, size in structs[name]:
        offset = ARRAY if size else 0
        if kind.startswith("sequence<"):
            kind, offset = kind[len("sequence<"):-1].strip(), SEQUENCE
        nested = ""
        if kind not in IDS:
            other = find(structs, kind, name)
            others.add(other)
            nested = ros_name(other)
        fields.append({"name": field, "type": {
            "type_id": IDS.get(kind, NESTED) + offset, "capacity": int(size or 0),
            "string_capacity": 0, "nested_type_name": nested}})
    return {"type_name": ros_name(name), "fields": fields}, others


def type_hash(structs, name):
    main, open_ones = described(structs, name)
    referenced = {}
    while open_ones:
        other = open_ones.pop()
        if other not in referenced:
            referenced[other], more = described(structs, other)
            open_ones |= more
    text = json.dumps({"type_description": main, "referenced_type_descriptions": sorted(
        referenced.values(), key=lambda d: d["type_name"])})
    return hashlib.sha256(text.encode()).hexdigest()


def main(folder, compiler, messages):
    structs = read(folder, compiler)
    hashes = {name: type_hash(structs, name) for name in structs}
    for name, value in hashes.items():
        if ros_name(name) in KNOWN and KNOWN[ros_name(name)] != value:
            sys.exit(f"{name}: {value}, in ROS 2 {KNOWN[ros_name(name)]}")
    text = open(messages, encoding="utf-8").read()
    topics = re.findall(r'_TOPIC\((\w+),[^")]*"(\w*)"\)', text)
    by_name = {name.replace("::", "_"): value for name, value in hashes.items()}
    wrong = [f"{name}: {by_name[name + '_']}" for name, value in topics
             if value != by_name[name + "_"] and value]
    without = [name for name, value in topics if not value]
    print(*wrong, sep="\n")
    # ROS 2 Humble knows no hashes.
    sys.exit(bool(wrong) or len(topics) < 25
             or without != ["rmw_dds_common_msg_older_ParticipantEntitiesInfo"])


main(*sys.argv[1:])
