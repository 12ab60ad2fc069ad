"""Sentences that the booth's processes say: examples for tests of their translation."""

from __future__ import annotations

SPOKEN = [
    "the cameras saw only 12 % of the left forearm",
    "camera back-upper: its time stamps do not advance; unplug the sensor and plug it in again",
    "camera a sends no frames (a sends no frames; reopening it); check its cable, see "
    "station status",
    "the left hand does not match the scan (120 cm2 of it lie 33 mm away)",
    "what nobody ever said; scan again",
    "with this calibration, heights could be wrong by up to 9.1 mm, but the limit is 5.0 mm "
    "(calibrate.height_limit_m): wave the ball longer",
    "camera front sends no frames; check its cable",
    "there is no scan with the label head",
    "the ball at the height of 1.710 m was seen 10 mm too low: measure the height of its underside "
    "above the floor again, and show the ball at its heights anew (station calibrate stand); if it "
    "was right, let the sensors warm up and wave the ball again",
    "the calibration that was started at 2026-11-21T10:00:00Z uses a ball with a radius of 0.1 m, "
    "but booth.toml says 0.2 m (calibrate.ball_radius_m): set it back if the ball is the same, or "
    "start again with station calibrate --new",
    "the ball was waved for 60 s; more of it would help (station calibrate ball): hold the ball in "
    "front of front-lower (0 of 120 times seen well)",
    "already recorded: the empty booth; 12 sightings of the waved ball; 1 place around it; "
    "the ball hanging at 1.8 and 0.7 m",
    "cameras a, b went silent; check their cables; scan again",
    "a/INDEX.txt, line 3: its ticks are those of line 1; record again",
    "kept, and not in use yet: the solution puts it into use",
    "calibration 20261101T100000Z cannot be used: camera a was calibrated and is not in "
    "booth.toml; cameras b, c are in booth.toml and were not calibrated; put the sensors and "
    "booth.toml back as they were, or run station calibrate",
    "the calibration that was started at 2026-11-21 10:00:00 is of other cameras: camera a is "
    "sensor A2, but A1 was calibrated; put the sensors and booth.toml back as they were, or start "
    "again with station calibrate --new",
    "camera a has moved since it was calibrated: by about 6 mm (mostly forward) and 0.4 degrees "
    "(mostly to the left)",
    "nothing of the person's back was seen; nothing of the left hand was seen",
    "the cloud shows only 12 % of the left forearm; the cloud shows only 12 % of the person's back",
    "camera a has moved since it was calibrated: by about 0.4 degrees (mostly clockwise)",
    "deliver orders: 3 not handed over (https://x cannot be reached (Connection refused)); it will "
    "be retried (at once: station deliver --now)",
    "deliver orders: the target has not responded for 75 s; check the network and the other "
    "machine",
    "deliver share: 1 not handed over (/mnt/x does not exist; is the share mounted?); it will be "
    "retried (at once: station deliver --now)",
]
