"""The SCAPE body model (Anguelov et al. 2005), how it is learned and how it is fitted."""
