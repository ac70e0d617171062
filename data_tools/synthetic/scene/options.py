"""Command-line options shared by all synthetic captures, and the `SyntheticCapture` that they describe."""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.rig.subject import Subject
from data_tools.synthetic.scene.backdrop import Room, make_room
from data_tools.synthetic.scene.ball import Ball
from data_tools.synthetic.scene.capture import (
    HeldOutTargets,
    SyntheticCapture,
    distance_to_middle_m,
    novel_cameras,
    portrait_camera,
)
from data_tools.synthetic.scene.film_alone import MIN_FRAMES as FILM_ALONE_MIN_FRAMES
from data_tools.synthetic.scene.film_alone import film_alone
from data_tools.synthetic.scene.motion import add_joint_angles, bend_at_hips, novel_motion, posture, turn_in_a_pose
from data_tools.synthetic.scene.renderer import LIGHTING_PRESETS
from data_tools.synthetic.scene.walk_around import make_surroundings, walking_shift_m
from pipeline.avatar.motion.retarget import resample_motion, retarget
from pipeline.body.body import Body, Motion
from pipeline.core.errors import UserError
from pipeline.geometry.camera import Camera
from pipeline.io.bvh import read_bvh
from pipeline.io.image import to_float, to_uint8

LIGHT_HELP = (
    "studio: ambient and key light; flat: unlit texture; shiny: studio with specular highlights; "
    "patch: studio with highlights on the chest only; two-shines: sharp ones on the chest, wide ones on the thighs; "
    "hard: strong key light with cast shadows"
)
MIN_FRAMES, MIN_SIZE_PX = 2, 32
MIN_FILL, MAX_FILL = 0.05, 0.95
MIN_CAMERA_HEIGHT_M = 0.05


def capture_parser(command: str, description: str) -> argparse.ArgumentParser:
    """Return a parser with the options that all captures share."""
    parser = argparse.ArgumentParser(
        prog=f"python -m data_tools.{command}",
        description=description,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--frames", type=int, default=96, help="number of frames")
    parser.add_argument("--fps", type=float, default=24.0, help="frames per second")
    parser.add_argument("--size", type=int, default=540, help="side of the square image in pixels, even")
    parser.add_argument("--distance", type=float, default=3.6, help="distance from camera to person in metres")
    parser.add_argument("--fill", type=float, default=0.82, help="fraction of the image height that the person covers")
    parser.add_argument("--focal", type=float, help="focal length in pixels; overrides --fill")
    parser.add_argument(
        "--pitch-deg", type=float, default=0.0, help="angle of the optical axis above the horizon, degrees"
    )
    parser.add_argument(
        "--roll-deg", type=float, default=0.0, help="clockwise roll of the camera about its optical axis, degrees"
    )
    parser.add_argument(
        "--hand-held-deg",
        type=float,
        default=0.0,
        help="angle by which a camera in the hand turns to both sides, degrees",
    )
    parser.add_argument(
        "--distortion", type=float, default=0.0, help="k1 of the lens (Brown); negative: straight lines bulge outwards"
    )
    parser.add_argument(
        "--walk-around", action="store_true", help="the person stands still and the camera is carried around"
    )
    parser.add_argument(
        "--film-alone", action="store_true", help="the person comes from the camera, turns, and goes back to it"
    )
    parser.add_argument(
        "--lean-deg",
        type=float,
        default=0.0,
        help="forward bend of the person at the hips in all frames, degrees; the legs stay as they are",
    )
    parser.add_argument(
        "--lower-arms-deg",
        type=float,
        default=0.0,
        help="angle by which both arms are lowered in all frames, degrees; -40: a T-pose",
    )
    parser.add_argument(
        "--close-legs-deg", type=float, default=0.0, help="angle by which both legs are closed in all frames, degrees"
    )
    parser.add_argument("--hand-on-hip", action="store_true", help="the left hand is on the hip in all frames")
    parser.add_argument("--specular", type=float, help="strength of the highlights, instead of that of --light")
    parser.add_argument("--light", choices=sorted(LIGHTING_PRESETS), default="studio", help=LIGHT_HELP)
    parser.add_argument(
        "--background", choices=("busy", "plain"), default="busy", help="busy: furnished room; plain: bare wall"
    )
    parser.add_argument("--samples", type=int, default=2, help="antialiasing samples per pixel and axis")
    parser.add_argument("--novel-views", type=int, default=4, help="number of novel cameras to render into truth/")
    parser.add_argument("--novel-poses", type=int, default=4, help="number of novel poses to render into truth/")
    parser.add_argument(
        "--novel-bvh", type=Path, help="BVH file for the novel poses, evenly spaced in time, without root translation"
    )
    parser.add_argument("--bvh", type=Path, help="BVH file with the motion, instead of the turn in A-pose")
    parser.add_argument(
        "--arc",
        type=float,
        default=360.0,
        help="angle of the turn in degrees; below 360 the person turns to both sides and back",
    )
    parser.add_argument("--turns", type=int, help="full turns in the frames, each in another posture; 1 if absent")
    parser.add_argument("--ball", action="store_true", help="add a juggled ball that occludes the person")
    parser.add_argument("--start", type=float, default=0.0, help="first time of the BVH motion to use, seconds")
    parser.add_argument(
        "--in-place", action="store_true", help="remove the horizontal root translation of the BVH motion"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of body shape, clothes and sway; equal seeds give equal bytes"
    )
    return parser


def validate_capture_options(options: argparse.Namespace) -> None:
    """Check the ranges of all numeric options.

    Raises:
        UserError: an option is out of range; the message names the option and its range.
    """
    bounds = (
        ("frames", MIN_FRAMES, 100_000),
        ("fps", 0.1, 1000.0),
        ("size", MIN_SIZE_PX, 4096),
        ("distance", 1.0, 50.0),
        ("fill", MIN_FILL, MAX_FILL),
        ("pitch_deg", -45.0, 45.0),
        ("roll_deg", -45.0, 45.0),
        ("hand_held_deg", 0.0, 10.0),
        ("lean_deg", -30.0, 60.0),
        ("lower_arms_deg", -60.0, 60.0),
        ("close_legs_deg", 0.0, 20.0),
        ("specular", 0.0, 1.0),
        ("samples", 1, 8),
        ("arc", 0.0, 360.0),
        ("turns", 1, 20),
        ("flare_m", 0.0, 0.6),
        ("hem_m", 0.02, 0.7),
        ("sleeve_flare_m", 0.0, 0.15),
        ("trouser_flare_m", 0.0, 0.15),
        ("jacket_m", 0.0, 0.08),
        ("heel_m", 0.0, 0.12),
        ("distortion", -0.5, 0.5),
        ("finger_mm", 1.0, 30.0),
        ("age", 0.0, 1.0),
        ("weight", 0.0, 1.0),
        ("novel_views", 0, 1000),
        ("novel_poses", 0, 1000),
        ("texture", 64, 8192),
        ("seed", 0, 2**31 - 1),
    )
    for name, low, high in bounds:
        value = getattr(options, name, low)
        if value is not None and not low <= value <= high:
            raise UserError(f"--{name.replace('_', '-')} {value} is out of range; choose a value from {low} to {high}")
    if options.turns is not None and (options.bvh or options.arc < 360.0):
        raise UserError("--turns is for the full turn in A-pose; remove it, or --bvh and --arc")
    if options.walk_around and (options.bvh or options.arc < 360.0 or options.ball):
        raise UserError("--walk-around is for a person who stands still; remove it, or --bvh, --arc and --ball")
    if options.film_alone and (options.bvh or options.arc < 360.0 or options.walk_around):
        raise UserError("--film-alone is for a full turn on the spot; remove it, or --bvh, --arc and --walk-around")
    if options.film_alone and options.frames < FILM_ALONE_MIN_FRAMES:
        raise UserError(f"--film-alone needs --frames {FILM_ALONE_MIN_FRAMES} at least, not {options.frames}")
    if options.size % 2:
        raise UserError(f"--size {options.size} is odd; H.264 needs an even size: choose {options.size + 1}")


def build_scene(options: argparse.Namespace, body: Body) -> tuple[Camera, np.ndarray, Room]:
    """Return camera, ground position (world, metres) and room for a person of this height.

    Raises:
        UserError: with this --focal the person would be too small or cropped, or with this --pitch-deg the camera would
            be below the floor.
    """
    fill = options.fill
    if options.focal is not None:
        focal_at_full_height_px = options.size * options.distance / body.height_m()
        fill = options.focal / focal_at_full_height_px
        if not MIN_FILL <= fill <= MAX_FILL:
            raise UserError(
                f"--focal {options.focal} makes the person cover {fill:.2f} of the image height; choose a value from "
                f"{MIN_FILL * focal_at_full_height_px:.0f} to {MAX_FILL * focal_at_full_height_px:.0f}, or another "
                "--distance"
            )
    camera, ground_m = portrait_camera(
        options.size, body.height_m(), options.distance, fill, options.pitch_deg, options.roll_deg
    )
    if camera.centre_m()[1] < ground_m[1] + MIN_CAMERA_HEIGHT_M:
        raise UserError(
            f"--pitch-deg {options.pitch_deg} puts the camera at --distance {options.distance} below the floor; choose "
            "a smaller pitch or distance"
        )
    room = make_room(camera, ground_m, options.background == "busy", ValueNoise(options.seed))
    return camera, ground_m, Room(to_float(to_uint8(room.image)), room.floor_m)


def build_motion(options: argparse.Namespace, body: Body, scene: tuple[Camera, np.ndarray, Room]) -> Motion:
    """Return the turn in A-pose, or the selected part of the --bvh file, in the posture of the options."""
    camera, ground_m, _ = scene
    if options.bvh:
        full_motion = retarget(read_bvh(options.bvh), body, ground_m, options.in_place)
        motion = resample_motion(full_motion, options.start, options.frames, options.fps)
    else:
        turns = options.turns or 1
        motion = turn_in_a_pose(body, options.frames, options.fps, ground_m, options.seed, options.arc, turns)
        if options.walk_around:
            shifted_m = motion.root_translation_m + walking_shift_m(motion.time_s)
            motion = motion.with_pose(motion.rotations_wxyz, shifted_m)
    if options.lower_arms_deg or options.close_legs_deg or options.hand_on_hip:
        angles = posture(options.lower_arms_deg, options.close_legs_deg, options.hand_on_hip)
        motion = add_joint_angles(body, motion, angles)
    if options.lean_deg:
        motion = bend_at_hips(body, motion, options.lean_deg)
    return film_alone(body, motion, ground_m, camera.centre_m()) if options.film_alone else motion


def build_novel_poses(options: argparse.Namespace, body: Body, ground_m: np.ndarray) -> Motion | None:
    """Return the novel poses: built-in, or from the --novel-bvh file; None with --novel-poses 0."""
    if not options.novel_poses:
        return None
    if not options.novel_bvh:
        return novel_motion(body, ground_m, options.novel_poses)
    full_motion = retarget(read_bvh(options.novel_bvh), body, ground_m, in_place=True)
    rows = np.linspace(0, len(full_motion.frame_index) - 1, options.novel_poses).round().astype(int)
    return replace(full_motion.select(rows), frame_index=np.arange(len(rows), dtype=np.int32))


def build_capture(
    options: argparse.Namespace, subject: Subject, motion: Motion, scene: tuple[Camera, np.ndarray, Room]
) -> tuple[SyntheticCapture, HeldOutTargets]:
    """Return the capture, and the novel views and poses to render for evaluation."""
    camera, ground_m, room = scene
    ball = Ball(ground_m, subject.body.height_m()) if options.ball else None
    light = LIGHTING_PRESETS[options.light]
    if options.specular is not None:
        light = replace(light, specular_strength=options.specular)
    capture = SyntheticCapture(
        subject,
        motion,
        camera,
        light,
        room,
        ground_m,
        options.fps,
        options.samples,
        ball,
        options.hand_held_deg,
        make_surroundings(camera, ground_m, options.background == "busy", ValueNoise(options.seed))
        if options.walk_around
        else None,
        options.distortion,
    )
    # The novel cameras show the first frame, in which a walking person may be metres from the middle of the trajectory.
    start_offset_m = motion.root_translation_m[0] - ground_m.astype(np.float32)
    person_position_m = ground_m + start_offset_m * [1.0, 0.0, 1.0]
    seen_from_m = ground_m if options.film_alone else person_position_m
    distance_m = distance_to_middle_m(camera, seen_from_m, subject.body.height_m())
    cameras = novel_cameras(camera, person_position_m, subject.body.height_m(), options.novel_views, distance_m)
    return capture, HeldOutTargets(cameras, build_novel_poses(options, subject.body, ground_m))


def settings_from_options(options: argparse.Namespace) -> dict[str, object]:
    """Return the options by name for `capture_settings.json`; of paths only the file names of the motions."""
    chosen = {
        name: value if isinstance(value, int | float | str) else str(value)
        for name, value in sorted(vars(options).items())
        if value is not None and not isinstance(value, Path)
    }
    novel = {"novel_motion": options.novel_bvh.name} if options.novel_bvh else {}
    return chosen | novel | {"motion": options.bvh.name if options.bvh else "turn"}
