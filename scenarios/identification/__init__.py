"""From a flight to an airframe file: `froude identify`.

Read `frequency_response` (what the telemetry says at each frequency of a multisine), `lateral_fit` (the six derivatives
that explain it, with intervals), `identified_airframe` (the file made of them).
"""
