"""Claims about the encoders: one latent per frame whatever the dtype, the shape or the company of the frame."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_ficreg import ConvEncoder, KeypointEncoder, ViTEncoder
from torchrl_ficreg.modules.keypoints import spatial_softmax
from torchrl_ficreg.modules.layers import IMAGENET_MEAN, IMAGENET_STD, PixelNormalizer

BUILD = {
    "conv": lambda **kwargs: ConvEncoder(image_size=16, channels=(4, 8), projector_dim=12, latent_dim=6, **kwargs),
    "keypoint": lambda **kwargs: KeypointEncoder(
        image_size=16, channels=(4, 8, 8), num_keypoints=5, latent_dim=6, **kwargs
    ),
    "vit": lambda **kwargs: ViTEncoder(
        image_size=16, patch_size=8, width=12, depth=2, heads=3, mlp_dim=16, projector_dim=12, latent_dim=6, **kwargs
    ),
}


@pytest.fixture(params=BUILD)
def build(request):
    return BUILD[request.param]


@pytest.fixture
def encoder(build):
    torch.manual_seed(0)
    return build().eval()


def frames(*lead):
    return torch.randint(0, 256, (*lead, 3, 16, 16), dtype=torch.uint8)


def test_bytes_and_their_share_of_255_give_one_latent(encoder):
    pixels = frames(5)
    torch.testing.assert_close(encoder(pixels=pixels / 255), encoder(pixels=pixels))


@pytest.mark.parametrize("grad", [True, False])
def test_no_frames_have_no_latents(encoder, grad):
    with torch.set_grad_enabled(grad):
        latent = encoder(pixels=frames(0))
    assert latent.shape == (0, 6) and latent.requires_grad == grad
    if grad:
        latent.sum().backward()


@pytest.mark.parametrize("lead", [(), (1,), (2, 4), (2, 1, 3)])
def test_leading_dimensions_are_frames_each_encoded_as_if_alone(encoder, lead):
    pixels = frames(*lead)
    latent = encoder(pixels=pixels)
    assert latent.shape == (*lead, 6)
    alone = torch.cat([encoder(pixels=frame[None]) for frame in pixels.reshape(-1, 3, 16, 16)])
    torch.testing.assert_close(latent.reshape(-1, 6), alone)


@pytest.mark.parametrize("default", [torch.float64, torch.bfloat16])
def test_the_default_dtype_of_a_script_decides_when_an_encoder_is_built_only(build, encoder, default):
    """Not what it computes in later."""
    pixels, before = frames(5), torch.get_default_dtype()
    expected = encoder(pixels=pixels)
    torch.set_default_dtype(default)
    try:
        assert encoder(pixels=pixels).equal(expected)
        assert build()(pixels=pixels).dtype == default
    finally:
        torch.set_default_dtype(before)
    torch.testing.assert_close(encoder.double()(pixels=pixels).float(), expected)


def test_a_mapped_encoder_compiles(encoder):
    pixels = frames(4, 2)
    compiled = torch.compile(torch.vmap(encoder.module), backend="eager")
    torch.testing.assert_close(compiled(pixels), encoder(pixels=pixels))


def test_every_pixel_has_a_gradient_under_torch_func_too(encoder):
    """Frame by frame, as for a map of what an encoder looks at."""
    pixels = torch.rand(4, 3, 16, 16, requires_grad=True)
    (expected,) = torch.autograd.grad(encoder(pixels=pixels).square().sum(), pixels)
    assert (expected != 0).all()
    found = torch.vmap(torch.func.grad(lambda frame: encoder.module(frame).square().sum()))(pixels)
    torch.testing.assert_close(found, expected)


def test_keys_can_be_renamed_nested_too(build, encoder):
    renamed = build(in_key=("obs", "rgb"), out_key=("belief", "z")).eval()
    renamed.load_state_dict(encoder.state_dict())
    pixels = frames(3)
    assert renamed(TensorDict({("obs", "rgb"): pixels}, [3]))["belief", "z"].equal(encoder(pixels=pixels))


def test_training_moves_the_running_statistics_once(build):
    encoder = build()
    encoder(pixels=frames(2, 4))
    (norm,) = [module for module in encoder.modules() if isinstance(module, torch.nn.BatchNorm1d)]
    assert norm.num_batches_tracked == 1


@pytest.mark.parametrize(
    ("pixels", "error", "message"),
    [
        (torch.zeros(2, 3, 8, 16, dtype=torch.uint8), ValueError, r"\[..., 3, 16, 16\] .* got \[2, 3, 8, 16\]"),
        (torch.zeros(2, 16, 16, 3, dtype=torch.uint8), ValueError, "permute the channels"),
        (torch.zeros(2, 3, 16, 16, dtype=torch.long), TypeError, "got torch.int64: convert them"),
        (torch.zeros(2, 3, 16, 16, dtype=torch.bool), TypeError, "got torch.bool: convert them"),
    ],
)
def test_other_frames_are_refused(encoder, pixels, error, message):
    with pytest.raises(error, match=message):
        encoder(pixels=pixels)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize(
    "change",
    [
        lambda share: share * 255,
        lambda share: 2 * share - 1,
        lambda share: (share - 0.45) / 0.225,
        lambda share: share.index_fill(0, torch.tensor(1), torch.nan),
        lambda share: share.index_fill(0, torch.tensor(1), torch.inf),
        lambda share: share.index_fill(0, torch.tensor(1), -torch.inf),
    ],
)
def test_floats_outside_their_range_are_refused_before_any_statistic_moves(build, change, dtype):
    """0..255, -1..1 and normalised frames, a NaN and infinities; the right floats are taken afterwards."""
    encoder, share = build(), (frames(4) / 255).to(dtype)
    state = {key: value.clone() for key, value in encoder.state_dict().items()}
    with pytest.raises(ValueError, match="floating pixels must lie in 0..1, got .*: divide 0..255 by 255"):
        encoder(pixels=change(share))
    assert all(value.equal(state[key]) for key, value in encoder.state_dict().items())
    assert encoder(pixels=share).isfinite().all()


def test_floats_can_be_normalized_under_a_transform_of_torch_func():
    """Where no value can be looked at, none is."""
    share, normalize = frames(2, 1) / 255, PixelNormalizer(16)
    torch.testing.assert_close(torch.func.vmap(normalize)(share).flatten(0, 1), normalize(share))
    assert torch.func.jacrev(lambda pixels: normalize(pixels).mean((-2, -1)))(share[0]).isfinite().all()


@pytest.mark.parametrize(
    ("make", "sizes", "message"),
    [
        (ConvEncoder, {"image_size": 18, "channels": (4, 8)}, "image_size 18 must be a multiple of 4"),
        (ViTEncoder, {"image_size": 20, "patch_size": 8}, "image_size 20 must be a multiple of patch_size 8"),
        (KeypointEncoder, {"image_size": 30}, "positive multiple of 4"),
        (KeypointEncoder, {"channels": (8, 8)}, "three layers"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(make, sizes, message):
    with pytest.raises(ValueError, match=message):
        make(**sizes)


def test_pixels_are_normalised_as_imagenet():
    pixels = frames(2)
    mean, std = (torch.tensor(value).view(3, 1, 1) for value in (IMAGENET_MEAN, IMAGENET_STD))
    normalizer = PixelNormalizer(16)
    torch.testing.assert_close(normalizer(pixels), (pixels / 255 - mean) / std, rtol=1e-5, atol=1e-5)
    assert not normalizer.state_dict()


def test_the_vision_transformer_sees_patches_in_reading_order():
    """Patch (row, column) is token row * columns + column, channels first: a convolution of stride 8."""
    network = BUILD["vit"]().module
    image = torch.randn(2, 3, 16, 16)
    cut = image.unfold(2, 8, 8).unfold(3, 8, 8).permute(0, 2, 3, 1, 4, 5).flatten(3).flatten(1, 2)
    kernel = network.to_patch.weight.unflatten(1, (3, 8, 8))
    expected = torch.nn.functional.conv2d(image, kernel, network.to_patch.bias, stride=8).flatten(2).transpose(1, 2)
    torch.testing.assert_close(network.to_patch(cut), expected, rtol=1e-4, atol=1e-5)


def test_a_spatial_softmax_tells_where_the_mass_of_a_map_is():
    """The place of a Gaussian bump, to a thousandth of the picture, wherever it lies between the pixels."""
    place = torch.rand(6, 2) - 0.5  # [N, (x, y)]
    grid = torch.linspace(-1, 1, 33)
    squared = (grid[None, None, :] - place[:, 0, None, None]) ** 2 + (grid[None, :, None] - place[:, 1, None, None]) ** 2
    found = spatial_softmax(-squared[:, None] / (2 * 0.1**2))  # [N, 2]
    torch.testing.assert_close(found, place, atol=1e-3, rtol=0)
