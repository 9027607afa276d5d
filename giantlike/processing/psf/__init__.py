"""Point spread functions: profiles, estimation from stars, empirical kernels."""
