// From linear light to display values.
vec3 tone_mapped(vec3 light) {
#ifdef FILMIC
    // fit of the ACES film curve [Narkowicz 2015]
    light = min(light, 1e4);
    light = (light * (2.51 * light + 0.03)) / (light * (2.43 * light + 0.59) + 0.14);
#endif
    return sqrt(light);
}
