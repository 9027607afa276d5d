"""Deprecated: names of triangulation, passes, cislunar, autonomy and dynamics by their old place, with a warning."""

from giantlike.core.deprecation import forward_names

__getattr__ = forward_names(
    __name__,
    {
        "giantlike.autonomy": "ModeMachine expected_dn find_patches identify_body pose_of_pair",
        "giantlike.autonomy.body_photometry": (
            "BodyLight Identified PatchOfLight PhotometricCamera chandrasekhar_sphere"
        ),
        "giantlike.autonomy.body_search": "SearchOptions SeenPatch pointing_slew",
        "giantlike.autonomy.camera_sources": (
            "CameraSource ExposureRequest FolderCamera SimulatedCamera TriggerPlan take_pair trigger_plan"
        ),
        "giantlike.autonomy.mode_machine": "InstrumentState Mode Slew Telemetry",
        "giantlike.autonomy.refraction": "SiteAtmosphere refracted:apply_refraction unrefracted:remove_refraction",
        "giantlike.autonomy.two_camera_pose": "Interlock PairPose carried_attitude",
        "giantlike.cislunar": (
            "BodyErrorModel BodyObservation FilterModel FilterState estimate_batch measurement_update time_update "
            "udu_factors"
        ),
        "giantlike.cislunar.batch": "BatchSolution",
        "giantlike.cislunar.body_measurements": (
            "TangentCamera angular_diameter disk_diameter measure_body measurement_partials "
            "position_from_measurement range_from_disk_diameter range_per_diameter range_sigma tangent_angles"
        ),
        "giantlike.cislunar.covariance": (
            "Dispersed after_coast after_correction after_image after_steps reference_steps"
        ),
        "giantlike.calibration.observability": "WeakCombination",
        "giantlike.calibration.options": "Treatment",
        "giantlike.cislunar.filter": "Innovations Transition coast maneuver predicted:predict_measurement",
        "giantlike.cislunar.linear_covariance": (
            "JointDispersion dispersed_correction dispersed_measurement dispersed_step"
        ),
        "giantlike.cislunar.udu": (
            "ScalarUpdate UduFactors considered_update gauss_markov_step gram_schmidt plus_dyad scalar_update"
        ),
        "giantlike.dynamics": "Flight PointMasses ThirdBody cislunar fly moon_position_km sun_position_km",
        "giantlike.passes": (
            "LimbPoints NavigationPass PassFix PassImage PassOptions PassTerm RunPass estimate_pass pass_from_run"
        ),
        "giantlike.passes.fix": "TermTest TimetagJitter",
        "giantlike.passes.images": "MeasuredPosition limb_waves wave_amplitudes",
        "giantlike.passes.run": "pass_from_rows",
        "giantlike.triangulation": (
            "Sightline StarEphemeris TriangulatedPosition TriangulationOptions locate sightline_of_fix "
            "sightline_of_pixel triangulate"
        ),
        "giantlike.triangulation.positions": "TriangulationMethod position_at_emission",
        "giantlike.triangulation.sightlines": "without_aberration",
    },
    until="0.4",
)
