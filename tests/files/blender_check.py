"""Imports a COLLADA avatar and poses it: blender -b --factory-startup --python-exit-code 1 --python THIS -- AVATAR.dae

Raises where Blender sees another avatar than the file describes."""

import math
import os
import sys
import xml.etree.ElementTree as ElementTree

import bpy
import mathutils

NEAR_M = 1e-4


def positions(mesh_object):
    """World positions of the mesh as it is posed now."""
    evaluated = mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = evaluated.to_mesh()
    result = [evaluated.matrix_world @ vertex.co for vertex in mesh.vertices]
    evaluated.to_mesh_clear()
    return result


def joints_of(path):
    """{name: parent's name or None} of the file's joint nodes."""
    joints = {}

    def walk(element, parent):
        for node in element.findall("{*}node"):
            is_joint = node.get("type") == "JOINT"
            if is_joint:
                joints[node.get("name")] = parent
            walk(node, node.get("name") if is_joint else parent)

    walk(ElementTree.parse(path).getroot().find(".//{*}visual_scene"), None)
    return joints


def family(joints, joint):
    """The joint and all that hang from it."""
    return {name for name in joints if name == joint or (joints[name] and joint in line(joints, name))}


def line(joints, joint):
    while joint:
        yield joint
        joint = joints[joint]


def check_look(mesh_object, folder):
    mesh = mesh_object.data
    assert len(mesh.uv_layers) == 1, "no uvs"
    assert len(mesh.materials) == 1, "no material"
    images = [node.image for node in mesh.materials[0].node_tree.nodes if node.type == "TEX_IMAGE"]
    assert len(images) == 1 and images[0].size[0] > 0, "no texture"
    assert os.path.dirname(os.path.abspath(bpy.path.abspath(images[0].filepath))) == folder, images[0].filepath
    heights = [p.z for p in positions(mesh_object)]
    assert min(heights) > -0.1 and max(heights) - min(heights) > 0.5, "does not stand on the floor"


def check_shapes(mesh_object, path):
    """The file's morph targets are shape keys: named alike, of the same positions."""
    root = ElementTree.parse(path).getroot()
    targets = root.findtext(".//{*}morph/{*}source/{*}IDREF_array", "").split()
    keys = mesh_object.data.shape_keys
    if not targets:
        assert keys is None, "shape keys from nowhere"
        return
    blocks = {block.name: block for block in keys.key_blocks}
    for target in targets:
        geometry = root.find(".//{*}geometry[@id='%s']" % target)
        numbers = [float(word) for word in geometry.findtext(".//{*}float_array").split()]
        block = blocks[geometry.get("name")]
        assert len(numbers) == 3 * len(block.data), target
        for i, point in enumerate(block.data):
            assert (point.co - mathutils.Vector(numbers[3 * i:3 * i + 3])).length < NEAR_M, (target, i)
    assert len(blocks) == len(targets) + 1, sorted(blocks)
    print("%d shape keys" % len(targets))


def check_pose(armature, mesh_object, joints):
    """Turns one bone after another; what is weighted to it and its family moves rigidly or blended, all else stays."""
    group_names = [group.name for group in mesh_object.vertex_groups]
    rest = positions(mesh_object)
    for joint in joints:
        bone = armature.pose.bones[joint]
        bone.rotation_mode = "QUATERNION"
        bone.rotation_quaternion = mathutils.Quaternion((1, 0.4, -0.3), math.radians(35))
        bpy.context.view_layer.update()
        moved = positions(mesh_object)
        to_world = armature.matrix_world @ bone.matrix @ bone.bone.matrix_local.inverted() @ armature.matrix_world.inverted()
        with_it = family(joints, joint)
        followers = 0
        for vertex, before, after in zip(mesh_object.data.vertices, rest, moved):
            share = sum(g.weight for g in vertex.groups if group_names[g.group] in with_it)
            expected = before.lerp(to_world @ before, share)
            assert (after - expected).length < NEAR_M, "%s moves vertex %d wrongly" % (joint, vertex.index)
            followers += share > 0.5
        print("%s moves %d vertices" % (joint, followers))
        bone.rotation_quaternion = mathutils.Quaternion()
    bpy.context.view_layer.update()


def main():
    path = sys.argv[sys.argv.index("--") + 1]
    joints = joints_of(path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert bpy.ops.wm.collada_import(filepath=path) == {"FINISHED"}
    meshes = [o for o in bpy.data.objects if o.type == "MESH"]
    assert len(meshes) == 1, "%d meshes" % len(meshes)
    check_shapes(meshes[0], path)
    check_look(meshes[0], os.path.dirname(os.path.abspath(path)))
    armatures = [o for o in bpy.data.objects if o.type == "ARMATURE"]
    if not joints:
        assert not armatures
        return
    assert len(armatures) == 1, "%d armatures" % len(armatures)
    bones = {bone.name: bone.parent.name if bone.parent else None for bone in armatures[0].data.bones}
    assert bones == joints, bones
    check_pose(armatures[0], meshes[0], joints)


main()
