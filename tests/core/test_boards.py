"""Boards: drawn in perspective, they are found where they were drawn."""

import cv2
import numpy as np
import pytest

from endo3d_core.calibrating.boards import Board

PX_PER_MM = 40
MARGIN_MM = 2.0
H = np.array([[0.9, 0.12, 60.0], [-0.08, 0.95, 50.0], [6e-5, -4e-5, 1.0]])
"""Drawn board (px) -> image."""


def drawn(board: Board) -> tuple[np.ndarray, np.ndarray]:
    """The image of a tilted board, and its features' true pixels."""
    points = board.points_mm[:, :2]
    if board.kind == "charuco":
        size = (board.columns * PX_PER_MM, board.rows * PX_PER_MM)
        flat = np.full((size[1] + 160, size[0] + 160), 255, np.uint8)
        flat[80:-80, 80:-80] = board._charuco().generateImage(size)
        # generateImage samples pixel centres: the board's origin is the corner of the first pixel.
        centres = points / board.pitch_mm * PX_PER_MM + 80 - 0.5
    else:
        extent = points.max(axis=0) + 2 * MARGIN_MM
        v, u = np.mgrid[0 : int(extent[1] * PX_PER_MM), 0 : int(extent[0] * PX_PER_MM)]
        x, y = u / PX_PER_MM - MARGIN_MM, v / PX_PER_MM - MARGIN_MM
        if board.kind == "checkerboard":
            inside = (np.abs(x - points[:, 0].max() / 2) < points[:, 0].max() / 2 + board.pitch_mm) & (
                np.abs(y - points[:, 1].max() / 2) < points[:, 1].max() / 2 + board.pitch_mm
            )
            dark = ((np.floor(x / board.pitch_mm) + np.floor(y / board.pitch_mm)) % 2 == 0) & inside
        else:
            dark = np.zeros(x.shape, bool)
            for cx, cy in points:
                dark |= (x - cx) ** 2 + (y - cy) ** 2 < (0.3 * board.pitch_mm) ** 2
        flat = np.where(dark, 40, 220).astype(np.uint8)
        centres = (points + MARGIN_MM) * PX_PER_MM
        if board.kind == "checkerboard":
            centres -= 0.5  # the edge lies between the last pixel of one square and the first of the next
    # Four times finer than the image: the drawing's own steps don't count.
    size = (int(flat.shape[1] * 1.1), int(flat.shape[0] * 1.1))
    finer = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])
    fine = cv2.warpPerspective(flat, finer @ H, (4 * size[0], 4 * size[1]), borderValue=220)
    image = cv2.GaussianBlur(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), (0, 0), 1.2)
    return image, cv2.perspectiveTransform(centres[None], H)[0]


@pytest.mark.parametrize(
    "text",
    [
        "checkerboard 9x7 pitch=1.5",
        "circles 8x6 pitch=1.5",
        "asymmetric-circles 4x9 pitch=1.0",
        "charuco 9x7 pitch=1.5 marker=1.1",
    ],
)
def test_a_drawn_board_is_found_where_it_was_drawn(text: str) -> None:
    board = Board.parse(text)
    image, truth = drawn(board)
    found = board.find(image)
    assert found is not None
    board_mm, pixels = found
    assert len(board_mm) == len(board.points_mm)
    # A symmetric board may be found turned by half a turn: the board's plane is what counts.
    turned = np.abs(pixels - truth[::-1]).max() < np.abs(pixels - truth).max()
    error = pixels - (truth[::-1] if turned else truth)
    # Perspective moves a circle's centre by a fraction of a pixel against its image's centre.
    assert np.sqrt(np.mean(error**2)) < (0.15 if "circles" in text else 0.05)
    np.testing.assert_array_equal(board_mm[:, 2], 0)


def test_nothing_is_found_where_nothing_is() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (300, 400), dtype=np.uint8)
    for text in ("checkerboard 5x4 pitch=1", "circles 5x4 pitch=1", "charuco 5x4 pitch=1"):
        assert Board.parse(text).find(noise) is None


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("chessboard 9x7 pitch=1", "starts with one of"),
        ("checkerboard 9 pitch=1", "columns x rows"),
        ("checkerboard 9x7", "needs pitch"),
        ("checkerboard 9x7 pitch=1 marker=2", "it takes pitch"),
        ("circles 9x7 pitch=one", "lengths in mm"),
        ("charuco 9x7 pitch=1 marker=1.5", "smaller"),
        ("charuco 9x7 pitch=1 dictionary=9X9", "no marker dictionary"),
        ("", "unknown board"),
    ],
)
def test_a_wrong_text_says_what_is_wrong(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        Board.parse(text)
