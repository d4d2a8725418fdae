"""A visual-inertial estimate on real IMU samples and simulated feature tracks: what debiasing is worth downstream."""
