"""What turns a scan bundle into a body: the SCAPE model, its fit, measurements and exports."""
