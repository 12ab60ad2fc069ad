"""The package installed on a machine of its own: `make test-install`."""
