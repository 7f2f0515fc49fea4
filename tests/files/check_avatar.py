#!/usr/bin/env python3
"""Checks a published avatar's folder with other people's readers: check_avatar.py AVATAR_DIR

Prints a line for each check: ok, FAILED with the reason, or SKIPPED where an optional program is not installed or npm
cannot reach what it needs.
Exit status: 0 nothing failed, 1 something failed, 77 the Python modules this needs are missing."""

import fcntl
import hashlib
import json
import os
import re
import shutil
import struct
import subprocess
import sys
import tempfile

SKIPPED = 77
try:
    import collada
    import collada.schema
    import lxml.etree
    import numpy as np
except ImportError as error:
    print("SKIPPED  everything: %s" % error)
    sys.exit(SKIPPED)

HERE = os.path.dirname(os.path.abspath(__file__))
PORTRAIT_SIZE = (768, 1024)
TOOL_TIMEOUT_S = 240


class Failed(Exception):
    """A check's finding."""


class Skipped(Exception):
    """Why a check could not be made."""


def require(condition, message):
    if not condition:
        raise Failed(message)


class Avatar:
    """What the checks share: the folder and what was read from it."""

    def __init__(self, folder):
        self.folder = folder
        self.metadata = json.loads(self.read("metadata.json"))
        self.rigged = self.metadata["joints"] > 0
        self.document = collada.Collada(self.path("avatar.dae"))

    def path(self, name):
        return os.path.join(self.folder, name)

    def read(self, name):
        with open(self.path(name), "rb") as file:
            return file.read()

    def morphs(self):
        """The morph controllers."""
        return [c for c in self.document.controllers if isinstance(c, collada.controller.Morph)]

    def primitive(self):
        shapes = [shape.id for morph in self.morphs() for shape, _ in morph]
        meshes = [geometry for geometry in self.document.geometries if geometry.id not in shapes]
        require(len(meshes) == 1, "there are %d geometries that are no shape" % len(meshes))
        require(len(meshes[0].primitives) == 1, "there are several primitives")
        return meshes[0].primitives[0]

    def skin(self):
        skins = [c for c in self.document.controllers if isinstance(c, collada.controller.Skin)]
        require(len(skins) == 1, "there are %d skins" % len(skins))
        return skins[0]

    def skeleton(self):
        """{joint: (parent or None, world_from_joint)} in document order, from the joint nodes of the scene."""
        joints = {}

        def walk(node, parent, world_from_parent):
            for child in node.children:
                if isinstance(child, collada.scene.Node):
                    world = world_from_parent @ child.matrix
                    if child.xmlnode.get("type") == "JOINT":
                        joints[child.xmlnode.get("sid")] = (parent, world)
                        walk(child, child.xmlnode.get("sid"), world)
                    else:
                        walk(child, parent, world)

        for node in self.document.scene.nodes:
            world = node.matrix
            if node.xmlnode.get("type") == "JOINT":
                joints[node.xmlnode.get("sid")] = (None, world)
                walk(node, node.xmlnode.get("sid"), world)
            else:
                walk(node, None, world)
        return joints


def png_header(png):
    """(width, height, channels) of a PNG with 8 bits a sample."""
    require(png[:8] == b"\x89PNG\r\n\x1a\n", "it is no PNG")
    width, height, bits, colour_type = struct.unpack(">IIBB", png[16:26])
    require(bits == 8, "it has %d bits a sample" % bits)
    return width, height, {0: 1, 2: 3, 6: 4}.get(colour_type)


def jpeg_header(jpeg):
    """(width, height, channels) of a JPEG."""
    at = 2
    while at + 9 < len(jpeg):
        require(jpeg[at] == 0xFF, "it is no JPEG")
        marker, length = jpeg[at + 1], struct.unpack(">H", jpeg[at + 2:at + 4])[0]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width, channels = struct.unpack(">HHB", jpeg[at + 5:at + 10])
            return width, height, channels
        at += 2 + length
    raise Failed("it is no JPEG")


def picture_header(content):
    return jpeg_header(content) if content[:2] == b"\xff\xd8" else png_header(content)


def pose(joints, turned, angle_rad):
    """{joint: world_from_joint} after joint `turned` has been turned about its own x axis; its children follow."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    turn = np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])
    posed = {}
    for name, (parent, world) in joints.items():
        if parent is None:
            posed[name] = world.copy()
        else:
            posed[name] = posed[parent] @ np.linalg.inv(joints[parent][1]) @ world
        if name == turned:
            posed[name] = posed[name] @ turn
    return posed


def deform(positions, weights, matrices):
    """Linear blend skinning: N x 3 positions, N x J weights, J x 4 x 4 matrices."""
    blended = np.einsum("nj,jab->nab", weights, matrices)
    homogeneous = np.c_[positions, np.ones(len(positions))]
    return np.einsum("nab,nb->na", blended, homogeneous)[:, :3]


# ---- the checks: each takes the Avatar and raises Failed ---------------------------------------------------------------


def files_are_as_listed(avatar):
    listed = avatar.metadata["files"]
    require(sorted(os.listdir(avatar.folder)) == sorted([*listed, "metadata.json"]),
            "the folder holds %s" % sorted(os.listdir(avatar.folder)))
    for name in ("avatar.dae", "avatar.glb", "preview.png"):
        require(name in listed, "%s is not listed" % name)
    for name, entry in listed.items():
        content = avatar.read(name)
        require(len(content) == entry["size"], "%s has another size" % name)
        require(hashlib.sha256(content).hexdigest() == entry["sha256"], "%s has another SHA-256" % name)
    for key, kind in {"id": str, "created": str, "label": str, "recording": str, "software_version": str,
                      "cameras": list, "warnings": list, "stage_seconds": dict, "triangles": int,
                      "joints": int}.items():
        require(isinstance(avatar.metadata.get(key), kind), "%s is no %s" % (key, kind.__name__))


def collada_is_schema_valid(avatar):
    validator = collada.schema.ColladaValidator()
    tree = lxml.etree.parse(avatar.path("avatar.dae"))
    valid = validator.validate(tree)
    require(valid, "%s" % validator.COLLADA_SCHEMA_1_4_1_INSTANCE.error_log)
    require(tree.getroot().get("version") == "1.4.1", "it is not version 1.4.1")


def collada_opens_without_errors(avatar):
    require(not avatar.document.errors, "%s" % avatar.document.errors)
    require(avatar.document.assetInfo.upaxis == collada.asset.UP_AXIS.Y_UP, "up is not Y")
    require(avatar.document.assetInfo.unitmeter == 1, "the unit is not the metre")


def mesh_is_complete(avatar):
    primitive = avatar.primitive()
    require(len(primitive) == avatar.metadata["triangles"], "%d triangles, not %d"
            % (len(primitive), avatar.metadata["triangles"]))
    positions, index = primitive.vertex, primitive.vertex_index
    require(np.isfinite(positions).all(), "a position is not finite")
    require(len(np.unique(index)) == len(positions), "a vertex belongs to no triangle")
    normals = primitive.normal[primitive.normal_index]
    require(np.abs(np.linalg.norm(normals, axis=2) - 1).max() < 1e-3, "a normal is not of unit length")
    uv = primitive.texcoordset[0][primitive.texcoord_indexset[0]]
    require(uv.min() >= 0 and uv.max() <= 1, "a uv lies outside 0 ... 1")


def mesh_is_a_closed_manifold(avatar):
    primitive = avatar.primitive()
    index = primitive.vertex_index.astype(np.int64)
    sides = np.concatenate([index[:, [0, 1]], index[:, [1, 2]], index[:, [2, 0]]])
    count = len(primitive.vertex)
    forward, backward = sides[:, 0] * count + sides[:, 1], sides[:, 1] * count + sides[:, 0]
    require(len(np.unique(forward)) == len(forward), "two triangles run the same way along an edge")
    require(np.isin(forward, backward).all(), "an edge has one triangle")
    corners = primitive.vertex[index].astype(float)
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    require(volume > 0, "the triangles face inwards")
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    require(areas.min() > 0, "a triangle is degenerate")


def texture_is_bound(avatar):
    require(len(avatar.document.materials) == 1, "there are %d materials" % len(avatar.document.materials))
    diffuse = avatar.document.materials[0].effect.diffuse
    require(isinstance(diffuse, collada.material.Map), "the diffuse colour is no texture")
    path = diffuse.sampler.surface.image.path
    require(not re.match(r"^([a-z]+:|/|\\)", path) and ".." not in path, "the path %r is not relative" % path)
    width, height, channels = picture_header(avatar.read(path))
    require(width > 0 and height > 0 and channels == 3, "the texture is no RGB picture")
    instances = list(avatar.document.scene.objects("controller" if avatar.rigged else "geometry"))
    require(len(instances) == 1, "the scene shows %d meshes" % len(instances))
    bound = next(iter(instances[0].primitives() if not avatar.rigged else instances[0].geometry.primitives()))
    require(bound.material is not None and bound.material.effect is avatar.document.materials[0].effect,
            "the mesh is shown without its material")


def skin_is_sound(avatar):
    skin = avatar.skin()
    require(np.allclose(skin.bind_shape_matrix, np.eye(4)), "the bind shape matrix is not the identity")
    require(len(skin.weight_joints) == avatar.metadata["joints"], "%d joints" % len(skin.weight_joints))
    require(len(skin) == len(avatar.primitive().vertex), "not every vertex has weights")
    for vertex, (joints, places) in enumerate(zip(skin.joint_index, skin.weight_index)):
        values = skin.weights[places].ravel()
        require(1 <= len(values) <= 4, "vertex %d has %d weights" % (vertex, len(values)))
        require((values > 0).all() and abs(values.astype(float).sum() - 1) < 1e-6,
                "vertex %d has weights %s" % (vertex, values))
        require(len(set(joints)) == len(joints), "vertex %d repeats a joint" % vertex)


def weights_sum_to_one_as_printed(avatar):
    """In whole hundred-thousandths, as a reader of decimals sees them."""
    from decimal import Decimal
    root = lxml.etree.parse(avatar.path("avatar.dae")).getroot()
    name = "{%s}" % root.nsmap[None]
    skin = root.find(".//%sskin" % name)
    table = skin.find("./%ssource[@id='avatar-weights']/%sfloat_array" % (name, name)).text.split()
    table = [Decimal(text) for text in table]
    counts = [int(text) for text in skin.find("./%svertex_weights/%svcount" % (name, name)).text.split()]
    places = [int(text) for text in skin.find("./%svertex_weights/%sv" % (name, name)).text.split()][1::2]
    at = 0
    for vertex, count in enumerate(counts):
        total = sum(table[place] for place in places[at:at + count])
        require(total == 1, "vertex %d: %s" % (vertex, total))
        at += count


def bind_pose_is_the_captured_pose(avatar):
    joints, skin = avatar.skeleton(), avatar.skin()
    require(list(joints) == list(skin.weight_joints.data.ravel()) or
            sorted(joints) == sorted(skin.weight_joints.data.ravel()), "the scene's joints are not the skin's")
    require(sum(parent is None for parent, _ in joints.values()) == 1, "there is more than one root")
    for name, (_, world) in joints.items():
        error = np.abs(world @ skin.joint_matrices[name] - np.eye(4)).max()
        require(error < 1e-5, "%s is %g away from its bind pose" % (name, error))


class Glb:
    """A binary glTF file, decoded."""

    COMPONENTS = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
    SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}

    def __init__(self, content):
        magic, version, length = struct.unpack("<4sII", content[:12])
        require(magic == b"glTF" and version == 2 and length == len(content), "the header is wrong")
        json_length, json_kind = struct.unpack("<I4s", content[12:20])
        require(json_kind == b"JSON" and json_length % 4 == 0, "there is no JSON chunk")
        self.json = json.loads(content[20:20 + json_length])
        at = 20 + json_length
        binary_length, binary_kind = struct.unpack("<I4s", content[at:at + 8])
        require(binary_kind == b"BIN\0" and at + 8 + binary_length == len(content), "there is no binary chunk")
        self.binary = content[at + 8:]

    def view(self, index):
        view = self.json["bufferViews"][index]
        begin = view.get("byteOffset", 0)
        require(begin + view["byteLength"] <= len(self.binary), "a buffer view ends beyond the buffer")
        return self.binary[begin:begin + view["byteLength"]]

    def array(self, index):
        accessor = self.json["accessors"][index]
        width = self.SIZES[accessor["type"]]
        values = np.frombuffer(self.view(accessor["bufferView"]), self.COMPONENTS[accessor["componentType"]])
        values = values.reshape(accessor["count"], width)
        for limit, found in (("min", values.min(0)), ("max", values.max(0))):
            require(limit not in accessor or np.array_equal(np.float32(accessor[limit]), np.float32(found)),
                    "an accessor's %s is wrong" % limit)
        return values

    def sparse(self, index, count):
        """The vectors of an accessor that is zero but where it says otherwise."""
        accessor = self.json["accessors"][index]
        require(accessor["count"] == count and "bufferView" not in accessor, "an accessor is not sparse")
        values = np.zeros((count, 3), np.float32)
        if "sparse" in accessor:
            places = np.frombuffer(self.view(accessor["sparse"]["indices"]["bufferView"]),
                                   self.COMPONENTS[accessor["sparse"]["indices"]["componentType"]])
            there = np.frombuffer(self.view(accessor["sparse"]["values"]["bufferView"]), np.float32).reshape(-1, 3)
            held = accessor["sparse"]["count"]
            values[places[:held]] = there[:held]
        return values


def glb_is_the_same_avatar(avatar):
    glb = Glb(avatar.read("avatar.glb"))
    primitive = glb.json["meshes"][0]["primitives"][0]
    attributes = {name: glb.array(index) for name, index in primitive["attributes"].items()}
    triangles = glb.array(primitive["indices"]).reshape(-1, 3)
    ours = avatar.primitive()
    require(len(triangles) == len(ours), "%d triangles" % len(triangles))
    require(np.array_equal(attributes["POSITION"][triangles], ours.vertex[ours.vertex_index].astype(np.float32)),
            "the positions differ from those of avatar.dae")
    uv = ours.texcoordset[0][ours.texcoord_indexset[0]] * [1, -1] + [0, 1]
    require(np.abs(attributes["TEXCOORD_0"][triangles] - uv).max() < 1e-6, "the uvs differ from those of avatar.dae")
    image = glb.json["images"][0]
    texture = avatar.document.materials[0].effect.diffuse.sampler.surface.image.path
    require(glb.view(image["bufferView"]) == avatar.read(texture), "the texture differs from %s" % texture)
    if avatar.rigged:
        glb_moves_alike(avatar, glb, attributes, triangles)


def morphs_are_those_of_the_glb(avatar):
    """Where avatar.dae holds morph targets, they are the shapes of avatar.glb."""
    morphs = avatar.morphs()
    if not morphs:
        return
    require(len(morphs) == 1, "there are %d morph controllers" % len(morphs))
    glb = Glb(avatar.read("avatar.glb"))
    mesh = glb.json["meshes"][0]
    require([shape.name for shape, _ in morphs[0]] == mesh["extras"]["targetNames"], "the shapes have other names")
    require(all(weight == 0 for _, weight in morphs[0]), "a shape is not at rest")
    ours = avatar.primitive()
    triangles = glb.array(mesh["primitives"][0]["indices"]).reshape(-1, 3)
    vertices = glb.json["accessors"][mesh["primitives"][0]["attributes"]["POSITION"]]["count"]
    for (shape, _), target in zip(morphs[0], mesh["primitives"][0]["targets"]):
        require(np.array_equal(shape.primitives[0].vertex_index, ours.vertex_index),
                "%s has other triangles" % shape.name)
        offsets = shape.primitives[0].vertex - ours.vertex
        error = np.abs(offsets[ours.vertex_index] - glb.sparse(target["POSITION"], vertices)[triangles]).max()
        require(error < 1e-5, "%s is off by %g m" % (shape.name, error))


def glb_moves_alike(avatar, glb, attributes, triangles):
    """Every joint turned in both files moves the same corners to the same places."""
    joints, skin = avatar.skeleton(), avatar.skin()
    names = list(skin.weight_joints.data.ravel())
    weights = np.zeros((len(skin), len(names)))
    for vertex, (who, places) in enumerate(zip(skin.joint_index, skin.weight_index)):
        weights[vertex, who] = skin.weights[places].ravel()

    glb_skin = glb.json["skins"][0]
    glb_names = [glb.json["nodes"][node]["name"] for node in glb_skin["joints"]]
    inverse_bind = glb.array(glb_skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1).astype(float)
    glb_weights = np.zeros((len(attributes["POSITION"]), len(glb_names)))
    for k in range(4):
        np.add.at(glb_weights, (np.arange(len(glb_weights)), attributes["JOINTS_0"][:, k]),
                  attributes["WEIGHTS_0"][:, k])
    require(np.abs(glb_weights.sum(1) - 1).max() < 1e-6, "weights do not sum to 1")

    index = avatar.primitive().vertex_index
    for turned in names:
        posed = pose(joints, turned, 0.7)
        moved = deform(avatar.primitive().vertex.astype(float), weights,
                       np.array([posed[name] @ skin.joint_matrices[name] for name in names]))
        glb_moved = deform(attributes["POSITION"].astype(float), glb_weights,
                           np.array([posed[name] @ inverse for name, inverse in zip(glb_names, inverse_bind)]))
        error = np.abs(moved[index] - glb_moved[triangles]).max()
        require(error < 1e-5, "turning %s moves a corner %g m away from where avatar.dae has it" % (turned, error))


def preview_is_a_portrait(avatar):
    width, height, channels = png_header(avatar.read("preview.png"))
    require((width, height) == PORTRAIT_SIZE and channels == 4, "%d x %d, %s channels" % (width, height, channels))


def run(command, **options):
    return subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                          timeout=TOOL_TIMEOUT_S, check=False, **options)


def skip_what_assimp_refuses(avatar):
    if avatar.morphs():
        raise Skipped("Assimp 5.2 takes the # of a morph controller's source for a part of its id, and refuses it")


def assimp_reads_both(avatar):
    skip_what_assimp_refuses(avatar)
    # Assimp leaves out joints that move no vertex, such as the crown's.
    moving = {joint for joints in avatar.skin().joint_index for joint in joints} if avatar.rigged else ()
    expected = {len(moving), avatar.metadata["joints"]}
    for name in ("avatar.dae", "avatar.glb"):
        info = run(["assimp", "info", avatar.path(name)])
        require(info.returncode == 0, "%s: %s" % (name, info.stdout[-300:]))
        numbers = {key: int(value) for key, value in re.findall(r"^(\w+):\s+(\d+)$", info.stdout, re.MULTILINE)}
        require(numbers.get("Meshes") == 1, "%s: %s meshes" % (name, numbers.get("Meshes")))
        require(numbers.get("Faces") == avatar.metadata["triangles"], "%s: %s faces" % (name, numbers.get("Faces")))
        require(numbers.get("Bones") in expected, "%s: %s bones" % (name, numbers.get("Bones")))


def assimp_converts(avatar):
    skip_what_assimp_refuses(avatar)
    with tempfile.TemporaryDirectory() as folder:
        converted = os.path.join(folder, "avatar.obj")
        result = run(["assimp", "export", avatar.path("avatar.dae"), converted])
        require(result.returncode == 0 and os.path.getsize(converted) > 0, result.stdout[-300:])
        with open(os.path.join(folder, "avatar.mtl"), encoding="utf-8") as materials:
            require("map_Kd" in materials.read(), "the texture got lost")


def blender_poses_it(avatar):
    with tempfile.TemporaryDirectory() as scratch:  # Blender would leave its own behind
        result = run(["blender", "-b", "--factory-startup", "--python-exit-code", "1", "--python",
                      os.path.join(HERE, "blender_check.py"), "--", os.path.abspath(avatar.path("avatar.dae"))],
                     env={**os.environ, "TMPDIR": scratch})
    require(result.returncode == 0, result.stdout[-500:])


def assimp_reads_the_mesh_files(avatar):
    for name in ("avatar.stl", "avatar.obj", "avatar.ply"):
        if name not in avatar.metadata["files"]:
            continue
        result = run(["assimp", "info", avatar.path(name)])
        require(result.returncode == 0, "%s: %s" % (name, result.stdout[-300:]))
        faces = re.search(r"^Faces: *(\d+)", result.stdout, re.M)
        require(faces and int(faces.group(1)) == avatar.metadata["triangles"], "%s: %s" % (name, faces))


def opencollada_finds_no_fault(avatar):
    # Its exit status says nothing, its words do.
    result = run(["opencolladavalidator", avatar.path("avatar.dae")])
    faults = [line for line in result.stdout.splitlines() if re.search("error|warning|fail", line, re.I)]
    require(not faults, "; ".join(faults[:3]))


def web_readers():
    """A folder with the npm packages that web_readers.mjs needs, installed on first use."""
    package = os.path.join(HERE, "package.json")
    with open(package, "rb") as content:
        version = hashlib.sha256(content.read()).hexdigest()[:12]
    folder = os.path.join(tempfile.gettempdir(), "avatar-booth-web-readers-%d-%s" % (os.getuid(), version))
    os.makedirs(folder, exist_ok=True)
    with open(os.path.join(folder, "lock"), "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # checks run side by side
        if not os.path.exists(os.path.join(folder, "complete")):
            shutil.copy(package, folder)
            try:
                result = run(["npm", "install", "--no-audit", "--no-fund", "--no-package-lock", "--prefix", folder])
            except subprocess.TimeoutExpired:
                raise Skipped("npm took too long to install three and gltf-validator")
            if result.returncode != 0:
                raise Skipped("npm could not install three and gltf-validator: %s" % result.stdout.strip()[-200:])
            with open(os.path.join(folder, "complete"), "w", encoding="utf-8"):
                pass
    return folder


def web_readers_agree(avatar):
    result = run(["node", os.path.join(HERE, "web_readers.mjs"), web_readers(), avatar.folder])
    require(result.returncode == 0, "\n" + result.stdout[-2000:])


CHECKS = [files_are_as_listed, collada_is_schema_valid, collada_opens_without_errors, mesh_is_complete,
          mesh_is_a_closed_manifold, texture_is_bound, glb_is_the_same_avatar, morphs_are_those_of_the_glb,
          preview_is_a_portrait]
CHECKS_OF_A_RIG = [skin_is_sound, weights_sum_to_one_as_printed, bind_pose_is_the_captured_pose]
CHECKS_WITH_PROGRAMS = [("assimp", assimp_reads_both), ("assimp", assimp_converts),
                        ("assimp", assimp_reads_the_mesh_files), ("opencolladavalidator", opencollada_finds_no_fault),
                        ("npm", web_readers_agree), ("blender", blender_poses_it)]


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    avatar = Avatar(sys.argv[1])
    checks = [(None, check) for check in CHECKS + (CHECKS_OF_A_RIG if avatar.rigged else [])]
    failures = 0
    for program, check in checks + CHECKS_WITH_PROGRAMS:
        name = check.__name__.replace("_", " ")
        if program and not shutil.which(program):
            print("SKIPPED  %s: no %s" % (name, program))
            continue
        try:
            check(avatar)
            print("ok       %s" % name)
        except Skipped as reason:
            print("SKIPPED  %s: %s" % (name, reason))
        except Exception as fault:  # whatever a reader throws at the file is a finding too
            failures += 1
            print("FAILED   %s: %s" % (name, fault if isinstance(fault, Failed) else repr(fault)))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
