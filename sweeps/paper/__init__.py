"""The experiments of Huang et al. (2023): case files, and the bad meshes of their section 3.5."""
