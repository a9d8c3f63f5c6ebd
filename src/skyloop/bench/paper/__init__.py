"""The paper's test flight (Mellado-Bataller et al., IAS-12, 2013): flown, recorded, and evaluated."""
