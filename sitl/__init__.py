"""The vehicle: plant, sensors, autopilot. No MAVLink, no socket, no wall clock."""
