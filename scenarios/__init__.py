"""The flights: scenarios, gain sets, runner, metrics, recordings."""
