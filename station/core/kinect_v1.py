"""A structured-light Kinect's errors in inverse depth, where they are the same at every range.

Random error of depth 1.425e-3 z^2 m (Khoshelham & Elberink 2012), so 1.425e-3 1/m of inverse depth,
growing as a surface is seen at a slant; steps of 1/8 px of disparity at a baseline of 75 mm and a
focal length of 585 px; errors correlated over the matching window.
"""

from __future__ import annotations

RANDOM_SIGMA = 1.425e-3
"""Of one pixel that sees a surface squarely, 1/m."""
STEP = 1.0 / (8.0 * 585.0 * 0.075)
"""Between neighbouring readings, 1/m."""
CORRELATED_PX = 32.0
"""Pixels that share one random error: a Gaussian window of 1.6 px has 4 pi 1.6^2."""
SQUARE_ERROR = CORRELATED_PX * RANDOM_SIGMA**2
"""Variance of the mean of n pixels is (SQUARE_ERROR / cosine + ROUNDING) / n."""
ROUNDING = STEP**2 / 12.0
"""Rounding errors of neighbouring pixels are independent: the random error spans half a step."""
INDEPENDENT_HZ = 20.0
"""Frames a second of what is waved at 0.4 m/s whose errors are nearly independent: at 1.7 m it
moves by 7 px in a twentieth of a second, over which the correlation of errors falls to a hundredth;
neighbours among 30 a second share an eighth. More of them would seem to say more than they do."""
