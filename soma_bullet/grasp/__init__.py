"""The hand as geometry: grasp sampling on facets, and the clearance of the hand at a grasp and along its way
out."""
