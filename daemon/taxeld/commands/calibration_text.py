"""A calibration in words: what was measured, how well, and what could not be."""

from collections.abc import Iterator

import numpy as np

from taxeld.commands.calibration_result import Result


def lines(result: Result) -> Iterator[str]:
    """For the text beside the file, and to print."""
    c, fit, heard = result.calibration, result.fit, result.heard
    layout = heard.model.layout
    x, y, yaw = c.mount
    x_sd, y_sd, yaw_sd = c.mount_sd
    yield f"calibration of {layout.name}, {len(layout)} taxels, on {c.object}"
    idle = heard.idle
    yield (
        f"idle       {idle.seconds:.0f} s: noise {np.median(c.noise_counts):.1f} counts (median), "
        f"{c.noise_counts.max():.1f} at most; drift {np.abs(idle.drift).max():.1f} counts/min at "
        "most"
    )
    held = f", {heard.moving} more were not held still" if heard.moving else ""
    yield f"presses    {c.presses}{held}; {int(fit.used.sum())} readings are used"
    where = "given" if result.given else "found by touch"
    ox, oy, oyaw = fit.object
    yield f"object     x {ox:.4f} m, y {oy:.4f} m, yaw {oyaw:.4f} rad, {where}"
    yield (
        f"mount      x {1e3 * x:+.2f} ± {1e3 * x_sd:.2f} mm, "
        f"y {1e3 * y:+.2f} ± {1e3 * y_sd:.2f} mm, "
        f"yaw {np.degrees(yaw):+.2f} ± {np.degrees(yaw_sd):.2f}°"
    )
    yield (
        f"full scale {c.full_scale_counts:.0f} counts ± {100 * c.full_scale_sd:.1f} % at "
        f"{1e3 * c.full_scale_depth_m:g} mm"
    )
    known = result.known
    spread = np.std(np.log(c.gain[known])) if known.sum() > 2 else float("nan")
    yield (
        f"gains      {int(known.sum())} of {len(layout)} taxels measured to "
        f"{100 * np.median(c.gain_sd[known]) if known.any() else 0:.1f} % (median), "
        f"spread {100 * spread:.0f} %; the others keep the spread of the skin"
    )
    onset = np.median(c.onset)
    yield f"response   bend {c.bend:+.3f} ± {c.bend_sd:.3f}; onsets {onset:+.2f} (median)"
    share = 100 * c.gain_cv
    yield f"activation noise {c.noise_sigma:.3f} of full scale, and {share:.0f} % of a reading"
    yield f"left over  {fit.chi:.2f} of what may be"
    frozen = np.flatnonzero(c.frozen).tolist()
    yield f"frozen     {', '.join(map(str, frozen)) if frozen else 'none'}"
