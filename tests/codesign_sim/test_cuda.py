"""What can be said about the CUDA kernels without a GPU."""

import numpy as np
import pytest
import warp as wp
from small_block import SMALL

from codesign_sim import Simulator, kernels


@pytest.mark.parametrize("architecture", [80, 90])
def test_the_kernels_compile_without_a_gpu(tmp_path, architecture):
    module = kernels.kernels(kernels.TEAM).module
    (cubin,) = wp.compile_aot_module(module, arch=architecture, module_dir=tmp_path, use_ptx=False)
    binary = cubin.read_bytes()
    assert binary[:4] == b"\x7fELF"
    for name in ("advance", "stress", "elastic"):
        assert f"{name}{kernels.TEAM}".encode() in binary


def test_without_a_gpu_the_error_says_what_to_do(monkeypatch):
    monkeypatch.setattr(wp, "get_cuda_devices", list)
    with pytest.raises(ValueError, match=r"no CUDA device 'cuda' found.*use device='cpu'"):
        Simulator(SMALL, device="cuda")


@pytest.mark.skipif(not wp.get_cuda_devices(), reason="needs an NVIDIA GPU")
def test_a_gpu_agrees_with_the_cpu(pads):
    from test_modes import grasp

    cpu, gpu = grasp(pads), grasp(pads, device="cuda")
    np.testing.assert_allclose(gpu.positions, cpu.positions, atol=2e-7)
    np.testing.assert_allclose(gpu.stress().von_mises, cpu.stress().von_mises, atol=0.5)
