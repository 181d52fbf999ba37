"""The server behind the page: where it listens, whom it answers, and that it opens no way to the outside."""

from __future__ import annotations

import socket
from dataclasses import replace

import numpy as np
import pytest
import torch

from rtgs.core.errors import RtgsError
from rtgs.view.settings import ViewerSettings

viser = pytest.importorskip("viser")

from rtgs.view.curves import Curves  # noqa: E402
from rtgs.view.page import open_page  # noqa: E402
from rtgs.view.server import is_loopback, serving  # noqa: E402
from tests.train.training_cases import small_scene  # noqa: E402


@pytest.fixture
def page():
    with open_page(ViewerSettings(port=0), "test", training=True) as opened:
        yield opened


def connect(page, origin: str | None):
    from websockets.sync.client import connect

    address = page.address.replace("http", "ws")
    return connect(address, origin=origin, subprotocols=[f"viser-v{viser.__version__}"], open_timeout=20)


@pytest.mark.parametrize("origin", [None, "http://localhost:8080", "http://127.0.0.1:9", "https://[::1]:8080"])
def test_its_own_pages_are_answered(page, origin):
    with connect(page, origin) as socket:
        assert socket.recv(timeout=20)


@pytest.mark.parametrize("origin", ["http://example.org", "http://localhost.example.org", "null", "http://127.0.0.1.a"])
def test_pages_of_others_are_refused(page, origin):
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus, match="403"):
        connect(page, origin)


def test_the_page_of_another_loopback_address_is_answered_and_those_of_others_are_not():
    from websockets.exceptions import InvalidStatus

    with open_page(ViewerSettings(host="127.0.0.2", port=0), "test", training=True) as page:
        assert page.address.startswith("http://127.0.0.2:")
        for origin in (page.address, "http://localhost:8080"):
            with connect(page, origin) as socket:
                assert socket.recv(timeout=20)
        for origin in ("http://127.0.0.3", "http://127a0.0.2", "http://127.0.0.2.example.org"):
            with pytest.raises(InvalidStatus, match="403"):
                connect(page, origin)


def test_it_listens_on_this_machine_alone(page):
    assert page.address.startswith("http://127.0.0.1:")
    assert page.server.get_host() == "127.0.0.1"
    assert is_loopback("::1")
    assert is_loopback("localhost")
    assert not is_loopback("0.0.0.0")
    assert not is_loopback("example.org")


def test_no_page_can_open_a_tunnel(page, monkeypatch):
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *given: pytest.fail("a tunnel was opened"))
    assert page.server.request_share_url() is None


def test_a_port_that_is_taken_gives_the_next_one():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with serving(ViewerSettings(port=port), "test") as server:
            assert server.get_port() != port


def test_an_address_of_another_machine_is_refused():
    with (
        pytest.raises(RtgsError, match=r"viewer.host=192\.0\.2\.1: this machine cannot listen there"),
        serving(ViewerSettings(host="192.0.2.1"), "test"),
    ):
        pass


def test_without_viser_it_is_said_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(RtgsError, match=r"needs viser: pip install -e '\.\[viewer\]'"), serving(ViewerSettings(), "a"):
        pass


def test_layers_appear_with_the_stage_that_makes_them_and_keep_their_weights(page):
    page.offer(("final", "depth"), ())
    assert not page._layers.visible
    page.offer(("final", "diffuse", "reflection"), ("diffuse", "reflection"))
    assert page._layers.visible
    switch, slider = page._weights["reflection"]
    slider.value = 0.5
    page._chosen()
    assert page.choice.weights == (("reflection", 0.5),)
    switch.value = False
    page._chosen()
    assert page.choice.weights == (("reflection", 0.0),)
    page.offer(("final", "diffuse", "reflection", "transmission"), ("diffuse", "reflection", "transmission"))
    assert page.choice.weights == (("reflection", 0.0),)


def test_cameras_photos_and_masks_of_a_capture(page):
    scene = small_scene()
    page.exhibit(scene, None)
    assert not page.around.visible
    page.around._cameras.value = True
    page.around._update()
    assert page.around.visible
    frusta = page.around._frusta
    assert len(frusta) == 6
    assert all(frustum.visible for frustum in frusta)
    centers = np.stack([frustum.position for frustum in frusta])
    np.testing.assert_allclose(centers, np.stack([v.camera.center.numpy() for v in (*scene.train, *scene.test)]))
    page.exhibit(scene, None)  # the next stage
    assert page.around._frusta is frusta


def test_a_hull_of_the_masks_is_carved_when_it_is_asked_for(page):
    """The masks of a unit sphere give it back, roughly; masks that bound nothing say so."""
    scene = small_scene(12)

    def seen(view):
        rays = view.camera.rays(torch.float64)
        direction = rays.directions / rays.directions.norm(dim=-1, keepdim=True)
        return torch.linalg.cross(direction, rays.origin.expand_as(direction)).norm(dim=-1) < 1

    masked = replace(scene, train=tuple(replace(view, mask=seen(view)) for view in scene.train))
    page.exhibit(scene, None)
    assert not page.around._hulled.visible
    page.exhibit(masked, None)
    assert page.around._hulled.visible
    assert page.around._hull is None
    page.around._hulled.value = True
    page.around._update()
    assert page.around.visible
    radii = np.linalg.norm(page.around._hull.vertices, axis=1)
    assert 0.8 < np.median(radii) < 1.3


def test_masks_that_bound_nothing_give_no_hull(page):
    scene = small_scene()
    full = replace(scene, train=tuple(replace(v, mask=torch.ones(30, 40, dtype=torch.bool)) for v in scene.train))
    page.exhibit(full, None)
    page.around._hulled.value = True
    page.around._update()
    assert page.around._hulled.label.startswith("no hull: ")
    assert not page.around.visible


def test_curves_are_plotted_once_there_are_two_points(page):
    curves = Curves([10], [0.5], [20.0], [float("nan")])
    page.plot(curves)
    assert page._plots == []
    page.plot(Curves([10, 20], [0.5, 0.4], [20.0, 21.0], [float("nan"), 19.0]))
    page.plot(Curves([10, 20, 30], [0.5, 0.4, 0.3], [20.0, 21.0, 22.0], [float("nan"), 19.0, 19.5]))
    assert len(page._plots) == 2
    assert len(page._plots[0].data[0]) == 3
