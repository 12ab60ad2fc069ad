"""From a scan bundle to a body: the SCAPE model, its fit, measurements and exports."""
