"""Script for a Python with Blender: a picture of a .glb under a lamp and a uniform sky, both without shadows.

python blender_lit.py avatar.glb FOLDER: import the file in its rest pose, and render it in Cycles with the camera of
FOLDER/camera.json and the light of FOLDER/light.json (`LampAndSky`) to FOLDER/blender.png.
"""

import json
import math
import sys
from pathlib import Path

import bpy
from blender_obj import TO_BLENDER, configure_render, place_camera
from mathutils import Matrix, Vector

SAMPLES = 64


def add_lamp(light):
    """Add a distant lamp without size; an irradiance of 1 shows a white surface as 1."""
    data = bpy.data.lights.new("lamp", "SUN")
    data.energy, data.angle, data.use_shadow = math.pi * light["key"], 0.0, False
    lamp = bpy.data.objects.new("lamp", data)
    towards = TO_BLENDER.to_3x3() @ Vector(light["direction"])
    lamp.matrix_world = Matrix.Rotation(0.0, 4, "Z") @ towards.to_track_quat("Z", "Y").to_matrix().to_4x4()
    bpy.context.collection.objects.link(lamp)


def add_sky(light):
    """Light diffuse surfaces from everywhere, as the hemisphere lights of real-time viewers do."""
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    background.inputs["Strength"].default_value = light["ambient"]
    world.cycles_visibility.glossy = False
    bpy.context.scene.world = world


def main(glb, folder):
    """Import and render."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=glb)
    for item in bpy.data.objects:
        item.animation_data_clear()
        if item.type == "ARMATURE":
            item.data.pose_position = "REST"
        # Real-time viewers and our rasteriser have no rays from surface to surface.
        item.visible_shadow = item.visible_diffuse = item.visible_glossy = False
        if item.type == "MESH" and item.find_armature() is None:
            item.hide_render = True  # the importer's shapes of bones
    light = json.loads((folder / "light.json").read_text())
    add_lamp(light)
    add_sky(light)
    place_camera(json.loads((folder / "camera.json").read_text()))
    configure_render(folder / "blender.png", SAMPLES)
    bpy.context.scene.render.film_transparent = True
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
