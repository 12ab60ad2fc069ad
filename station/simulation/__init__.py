"""The virtual sensor and booth, for tests, the demo and `station record-virtual`.
Nothing else imports it; the virtual driver is found like every other driver.
"""
