"""Evidence of a person whom frames show well from all sides."""

import numpy as np

from pipeline.body.body import Body
from pipeline.mesh.extraction.evidence import NORMALS, Evidence, RingEvidence


def full_evidence(body: Body) -> Evidence:
    return Evidence(np.ones(len(body.vertices)), RingEvidence(np.ones(NORMALS), np.ones(NORMALS)))
