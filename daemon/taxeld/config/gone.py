"""What this version no longer has, each with what replaces it.

A configuration's key (`table.key`) or its value (`table.key = "value"`), a command
(`taxeld-hil draw`) or an option (`--truth`) that stands here is refused with its line. The table is
emptied at the next minor version.
"""

ICUB = "an iCub's skin comes as an array (docs/array.md)"
MEASURED = "'taxeld calibrate' measures it, and skin.calibration has its figure"
WHOLE = "'evaluate whole' compares filters, 'evaluate map' has what ships under each condition"
NAMED = "say it with --cells, which names cells, methods, guides and motions"
EFFORT = "--effort scales training, measuring and trials together"
KEPT = "finished runs are kept in .experiments, where the command was given"
IN_FILE = "the scenario's file has its bundle, physics (the foam) and layout"
SESSION = "'taxeld replay DIR' plays a session, and 'taxeld view DIR' shows it"
WATCH = "'taxeld status' prints what a daemon believes, 'taxeld view' draws it"
FIXED = "its value is fixed now; delete the line"
CELLS = "say 'evaluate map', and choose --cells"

GONE: dict[str, str] = {
    "advice": "taxeld advise CONFIG asks the daemon what it has felt, and advises; see its options",
    "taxeld-hil draw": "'taxeld view DIR' draws a session",
    "taxeld-hil table": "'taxeld-hil matrix' has in which signs each fault showed, and how soon",
    "taxeld-hil run --png": "'taxeld view DIR' draws the session, in a window or by --save FILE",
    "taxeld-hil run --transport": "the scenario's file has its transport",
    "taxeld-hil matrix --real": "'taxeld-hil run' plays a scenario in real time",
    **{f"taxeld-hil {name} --memory": KEPT for name in ("expect", "matrix")},
    "taxeld-hil expect --minutes": "stop it when you like: the same command goes on",
    **{f"taxeld-hil emulate --{name}": IN_FILE for name in ("foam", "layout", "skin")},
    "taxeld-hil run --limit-s": "a run on hardware may take two minutes a contact",
    **{f"taxeld-train evaluate {name}": WHOLE for name in ("ablation", "filter", "frontier")},
    "taxeld-train evaluate integrity": "'evaluate map' counts what misleads",
    "taxeld-train evaluate reliability": "'evaluate map' has what p promises, part by part",
    "taxeld-train evaluate stability": "say 'evaluate map'",
    "taxeld-train evaluate recognise": "say 'evaluate which'",
    "taxeld-train evaluate links": "say 'evaluate map --cells \"two links\"'",
    "taxeld-train evaluate proposals": "say 'evaluate samplers'",
    "taxeld-train evaluate --columns": "a ring of 8 columns is --cells 'columns 8'",
    "taxeld-train evaluate --groups": NAMED,
    "taxeld-train evaluate --effort": "questions.toml has the effort of each question",
    "taxeld-train evaluate --minutes": "stop it when you like: the same command goes on",
    "taxeld-train evaluate --seed": "say --seeds FIRST-LAST",
    **{f"taxeld-train evaluate {name}": CELLS for name in ("sizes", "skins", "shipped", "damage")},
    "taxeld-train build --samplers": "they are made, of several objects too; --table makes none",
    "taxeld-train build --quick": "say --table, or --effort 0.02 for a poor sampler in a minute",
    **{
        f"taxeld-train build --{name}": EFFORT
        for name in ("contacts", "bank", "readings", "trials")
    },
    "taxeld-train build --seed": "builds are the same each time",
    "taxeld-train build --skin": "say --layout",
    "taxeld-train scene --skin": "say --layout",
    "taxeld-hil physics": "'taxeld-hil expect' has how well touches of a soft skin find an object",
    **{f"taxeld-hil {name} --skin": "say --foam" for name in ("run", "matrix")},
    "taxeld-hil calibration": "taxeld calibrate SESSION --check judges a skin's own touches",
    "scene.max_objects": "one object is estimated; a second one shows as `other` or `moved`",
    "--histogram": "lat_us of 'taxeld status' and /taxeld/health has median, 99 % and the longest",
    **{f"source.{key}": ICUB for key in ("dialect", "boards", "skin_type", "shift_bits")},
    **{f"source.{key}": ICUB for key in ("offset_counts", "no_load_counts")},
    **{f"skin.{key}": FIXED for key in ("baseline_scans", "drift_s", "state_max_age_s")},
    "skin.calibration_max_age_days": "after 180 days a calibration is refused: calibrate again",
    "skin.calibration_required": "leave skin.calibration empty to run without one",
    **{f"filter.{key}": FIXED for key in ("kld_error", "kld_confidence", "injected_decay")},
    **{f"filter.{key}": FIXED for key in ("project", "memory", "outliers")},
    "filter.sampler": "name the sampler in filter.proposal",
    **{f"sensor_pose.{key}": FIXED for key in ("max_age_s", "extrapolate_s", "within_m")},
    "source.max_age_s": FIXED,
    "loop.stale_s": FIXED,
    "relay.frames": "messages have three frames: use a PlotJuggler after 3.17.2",
    "curve.loopback": "loopback is open to this machine: use a Unix socket there",
    "metrics": "subscribe to /taxeld/health",
    'source.kind = "replay"': SESSION,
    "source.path": SESSION,
    "source.framing": 'an SLCAN adapter is kind = "can", interface = "slcan"',
    "source.baud": "add it to source.channel, as /dev/ttyACM0@921600",
    "skin.learn": "it is on; no experiment has shown that it costs touches",
    "budget": "auto takes the bundle's first that needs 5 ms; filter.proposal names another",
    "filter.noise_sigma": MEASURED,
    "filter.gain_cv": MEASURED,
    "filter.keep_s": "10 minutes; 'taxeld reset' forgets what was felt, and so does a start later",
    "control.group": "members of the group taxeld-control may tare and reset",
    "--dialect": ICUB,
    "taxeld watch": WATCH,
    "taxeld-hil watch": WATCH,
    "--sensor-tf": "examples/tf_to_pose.py publishes a frame of tf for --sensor-topic",
    "--sensor-endpoint": "CONFIG says where: sensor_pose.endpoint",
    "--domain": "set ROS_DOMAIN_ID in the environment",
    "--no-markers": "there are none: /taxeld/modes has the poses",
    "--z-m": "name a frame at that height with --frame",
    "taxeld view --truth": "a simulated session has its truth.csv, which is drawn",
    "--web": "use --save FILE, and where the browser is: rerun --web-viewer FILE",
    "taxeld relay": "'taxeld run' serves relay.publish and relay.control of its configuration",
    "taxeld init --no-object": "leave --bundle out",
    "taxeld init --keys": "set curve.directory in the file that it writes",
    "taxeld init --where": "set filter.centre_m and half_width_m in the file that it writes",
    "taxeld prior --yaw": "say --at X Y YAW",
    **{f"taxeld prior --{name}": "control's `prior` takes it" for name in ("object", "weight")},
    "taxeld layout --png": "'taxeld view' shows the skin of a daemon or of a session",
    "--log-level": "set log.level in CONFIG",
    "--running": "what a running daemon has in use is no fault, if it answers",
    "--interface": "keep one interface's lines, as by grep ' can0 ' LOG",
    "--dask": "say --workers ADDRESS",
    "taxeld-hil run --view": "'taxeld view' shows the session that it names",
    "--endpoint": "name the endpoint in place of CONFIG",
    "--stream": "name the endpoint in place of CONFIG",
    "--keys": "set TAXELD_KEYS=DIR in the environment",
    "taxeld calibrate --presses": "it takes 20",
    "taxeld calibrate --idle-s": "it listens to the idle skin for a minute",
    "taxeld calibrate --config": "write what is to change into the session's config.toml",
    "taxeld export": "run taxeld-ros2 and record its topics with 'ros2 bag'",
}


def why(name: str) -> str | None:
    """One line about a key, value, command or option that is gone; None where it never was."""
    return f"{name}: is gone; {GONE[name]}" if name in GONE else None
