"""Script for a Python with Blender (`bpy` from PyPI, in a separate environment).

python blender_obj.py avatar.obj FOLDER: import the file, render its diffuse map without lights with the camera of
FOLDER/camera.json to FOLDER/blender.png, and write what was found to FOLDER/found.npz.
"""

import json
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

TO_BLENDER = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))  # +Y up to +Z up


def place_camera(settings):
    """Add a camera with these intrinsics; square pixels."""
    data = bpy.data.cameras.new("camera")
    camera = bpy.data.objects.new("camera", data)
    bpy.context.collection.objects.link(camera)
    camera.matrix_world = TO_BLENDER @ Matrix(settings["camera_to_world"])
    width, height = settings["width"], settings["height"]
    longer = max(width, height)
    data.sensor_fit, data.sensor_width = "AUTO", 36.0
    data.lens = settings["fx"] * 36.0 / longer
    data.shift_x = (0.5 * width - settings["cx"]) / longer
    data.shift_y = (settings["cy"] - 0.5 * height) / longer
    data.clip_start, data.clip_end = 0.05, 1000.0
    scene = bpy.context.scene
    scene.camera, scene.render.resolution_x, scene.render.resolution_y = camera, width, height
    scene.render.resolution_percentage = 100


def show_diffuse_only(material):
    """Replace the shader by an emission of its base colour; return the names of the images of base and specular."""
    tree = material.node_tree
    shader = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    colour = shader.inputs["Base Color"].links[0].from_node
    images = [node.image.name for node in tree.nodes if node.type == "TEX_IMAGE" and node.image]
    emission = tree.nodes.new("ShaderNodeEmission")
    tree.links.new(colour.outputs["Color"], emission.inputs["Color"])
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    return colour.image.name, images


def configure_render(picture, samples):
    """Render to a file with the mean of some samples in the square of a pixel."""
    scene = bpy.context.scene
    scene.render.engine, scene.render.filepath = "CYCLES", str(picture)
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = samples, False, False
    scene.cycles.pixel_filter_type, scene.cycles.max_bounces = "BOX", 0
    scene.view_settings.view_transform = "Standard"


def render(picture):
    """Render on white."""
    configure_render(picture, samples=256)
    world = bpy.data.worlds.new("white")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    bpy.context.scene.world = world
    bpy.ops.render.render(write_still=True)


def main(obj, folder):
    """Import, measure, render."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.obj_import(filepath=obj)
    mesh = next(item for item in bpy.data.objects if item.type == "MESH")
    vertices = np.array([(mesh.matrix_world @ vertex.co)[:] for vertex in mesh.data.vertices])
    base, images = show_diffuse_only(mesh.data.materials[0])
    place_camera(json.loads((folder / "camera.json").read_text()))
    render(folder / "blender.png")
    np.savez(folder / "found.npz", vertices_m=vertices[:, [0, 2, 1]] * [1, 1, -1], base=base, images=images)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
