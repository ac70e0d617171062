"""Script for a Python with Blender (`bpy` from PyPI, in a separate environment).

python blender_import.py avatar.glb picture.png [seconds]: import the file, seek to that time, render an image and print
the findings as JSON.
"""

import json
import sys

import bpy
from mathutils import Vector


def posed_bounding_box(mesh):
    """Return the minimum and maximum corner of the posed mesh, in Blender's world (+Z up)."""
    evaluated = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = [evaluated.matrix_world @ vertex.co for vertex in evaluated.data.vertices]
    return [min(p[k] for p in points) for k in range(3)], [max(p[k] for p in points) for k in range(3)]


def render(picture, low, high):
    """Render an image from the front under uniform light, for visual inspection."""
    centre, height = (
        [(a + b) / 2 for a, b in zip(low, high, strict=True)],
        max(b - a for a, b in zip(low, high, strict=True)),
    )
    data = bpy.data.cameras.new("preview_camera")
    camera = bpy.data.objects.new("preview_camera", data)
    bpy.context.collection.objects.link(camera)
    camera.location = Vector(centre) + Vector((0.6, -3.0, 0.3)) * height
    camera.rotation_euler = (Vector(centre) - camera.location).to_track_quat("-Z", "Y").to_euler()
    data.lens = 80.0
    scene = bpy.context.scene
    scene.camera, scene.render.engine, scene.render.filepath = camera, "CYCLES", picture
    scene.cycles.samples, scene.cycles.device, scene.cycles.use_denoising = 8, "CPU", False
    scene.render.resolution_x, scene.render.resolution_y = 420, 560
    world = bpy.data.worlds.new("bright")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = 1.0
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    scene.world, scene.view_settings.view_transform = world, "Standard"
    bpy.ops.render.render(write_still=True)


def main(path, picture, seconds):
    """Import, pose, measure, render, report."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=path)
    objects = list(bpy.data.objects)
    skinned = [o for o in objects if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers)]
    bpy.context.scene.frame_set(round(seconds * bpy.context.scene.render.fps))
    low, high = posed_bounding_box(skinned[0])
    render(picture, low, high)
    found = {
        "armatures": sum(o.type == "ARMATURE" for o in objects),
        "skinned_meshes": len(skinned),
        "actions": [action.name for action in bpy.data.actions],
        "bones": sum(len(armature.bones) for armature in bpy.data.armatures),
        "images": sorted(image.name for image in bpy.data.images if image.size[0] > 0),
        "low_m": low,
        "high_m": high,
    }
    print("RESULT " + json.dumps(found))


main(sys.argv[1], sys.argv[2], float(sys.argv[3]) if len(sys.argv) > 3 else 0.0)
