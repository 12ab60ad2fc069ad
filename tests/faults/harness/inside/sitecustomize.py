"""Imported at the start of each process of a booth under test: its jobs become errant ones."""

import os
import sys

if "BOOTH_JOB_ORDER" in os.environ and "workers.reconstruct.job_process" in sys.orig_argv:
    import errant_job

    sys.modules["workers.reconstruct.job"] = errant_job
