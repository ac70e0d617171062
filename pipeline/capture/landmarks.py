"""The 33 pose landmarks of MediaPipe (BlazePose), in its order, and groups of them.

Bazarevsky et al., "BlazePose: On-device real-time body pose tracking", 2020. Left and right are the person's own.
"""

from enum import IntEnum


class PoseLandmark(IntEnum):
    """Index of each landmark in arrays with an axis of 33."""

    NOSE = 0
    LEFT_EYE_INNER = 1
    LEFT_EYE = 2
    LEFT_EYE_OUTER = 3
    RIGHT_EYE_INNER = 4
    RIGHT_EYE = 5
    RIGHT_EYE_OUTER = 6
    LEFT_EAR = 7
    RIGHT_EAR = 8
    MOUTH_LEFT = 9
    MOUTH_RIGHT = 10
    LEFT_SHOULDER = 11
    RIGHT_SHOULDER = 12
    LEFT_ELBOW = 13
    RIGHT_ELBOW = 14
    LEFT_WRIST = 15
    RIGHT_WRIST = 16
    LEFT_PINKY = 17
    RIGHT_PINKY = 18
    LEFT_INDEX = 19
    RIGHT_INDEX = 20
    LEFT_THUMB = 21
    RIGHT_THUMB = 22
    LEFT_HIP = 23
    RIGHT_HIP = 24
    LEFT_KNEE = 25
    RIGHT_KNEE = 26
    LEFT_ANKLE = 27
    RIGHT_ANKLE = 28
    LEFT_HEEL = 29
    RIGHT_HEEL = 30
    LEFT_FOOT_INDEX = 31
    RIGHT_FOOT_INDEX = 32


_P = PoseLandmark
N_LANDMARKS = len(PoseLandmark)
TORSO = (_P.LEFT_SHOULDER, _P.RIGHT_SHOULDER, _P.LEFT_HIP, _P.RIGHT_HIP)
KNEES, ANKLES = (_P.LEFT_KNEE, _P.RIGHT_KNEE), (_P.LEFT_ANKLE, _P.RIGHT_ANKLE)
FEET = (_P.LEFT_HEEL, _P.RIGHT_HEEL, _P.LEFT_FOOT_INDEX, _P.RIGHT_FOOT_INDEX)
WRISTS, PINKIES = (_P.LEFT_WRIST, _P.RIGHT_WRIST), (_P.LEFT_PINKY, _P.RIGHT_PINKY)
INDEX_FINGERS = (_P.LEFT_INDEX, _P.RIGHT_INDEX)
POSE_CONNECTIONS = (
    (_P.LEFT_SHOULDER, _P.RIGHT_SHOULDER),
    (_P.LEFT_SHOULDER, _P.LEFT_HIP),
    (_P.RIGHT_SHOULDER, _P.RIGHT_HIP),
    (_P.LEFT_HIP, _P.RIGHT_HIP),
    (_P.LEFT_SHOULDER, _P.LEFT_ELBOW),
    (_P.LEFT_ELBOW, _P.LEFT_WRIST),
    (_P.RIGHT_SHOULDER, _P.RIGHT_ELBOW),
    (_P.RIGHT_ELBOW, _P.RIGHT_WRIST),
    (_P.LEFT_WRIST, _P.LEFT_INDEX),
    (_P.RIGHT_WRIST, _P.RIGHT_INDEX),
    (_P.LEFT_HIP, _P.LEFT_KNEE),
    (_P.LEFT_KNEE, _P.LEFT_ANKLE),
    (_P.RIGHT_HIP, _P.RIGHT_KNEE),
    (_P.RIGHT_KNEE, _P.RIGHT_ANKLE),
    (_P.LEFT_ANKLE, _P.LEFT_FOOT_INDEX),
    (_P.RIGHT_ANKLE, _P.RIGHT_FOOT_INDEX),
    (_P.LEFT_ANKLE, _P.LEFT_HEEL),
    (_P.RIGHT_ANKLE, _P.RIGHT_HEEL),
    (_P.NOSE, _P.LEFT_SHOULDER),
    (_P.NOSE, _P.RIGHT_SHOULDER),
)
"""Bones of the contact sheet. An odd second index is on the left side."""
