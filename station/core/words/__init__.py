"""Words that the booth and its workers share: names of measurements."""
