"""Choice of the compute device."""

import pytest
import torch

from pipeline.core.device import CPU, select_device
from pipeline.core.errors import UserError


def test_without_a_gpu_auto_is_the_cpu_and_cuda_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert select_device("auto", "field.device") == select_device("cpu", "field.device") == CPU
    with pytest.raises(UserError, match=r"field\.device=cuda.*EXTRA=cuda.*field\.device=cpu"):
        select_device("cuda", "field.device")


def test_with_a_gpu_auto_selects_it_and_cpu_does_not(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    assert select_device("auto", "field.device") == select_device("cuda", "field.device") == torch.device("cuda:0")
    assert select_device("cpu", "field.device") == CPU
