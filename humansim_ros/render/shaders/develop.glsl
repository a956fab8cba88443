// From linear light to what is shown.
vec3 developed(vec3 light) {
#ifdef FILMIC
    // the ACES film curve as fitted by K. Narkowicz (2015)
    light = min(light, 1e4);
    light = (light * (2.51 * light + 0.03)) / (light * (2.43 * light + 0.59) + 0.14);
#endif
    return sqrt(light);
}
