// Reflection terms of skin and cloth. They vary slowly and bodies have many vertices: they are computed per vertex.
#define SKIN_F0 0.028      // reflectance at normal incidence of refractive index 1.4
#define SKIN_SHARPNESS 14.0 // Blinn-Phong exponent: rough
vec3 skin_and_cloth_terms(vec3 n, vec3 v, vec3 sun) {
    float nl = dot(n, sun), nv = clamp(dot(n, v), 0.0, 1.0), lv = dot(sun, v);
    vec3 h = (sun + v) * inversesqrt(max(2.0 + 2.0 * lv, 1e-6));
    float nh = max(dot(n, h), 0.0), away = 1.0 - sqrt(max(0.5 + 0.5 * lv, 0.0));
    // Schlick's approximation of the Fresnel term
    float a2 = away * away, fresnel = SKIN_F0 + (1.0 - SKIN_F0) * a2 * a2 * away;
    float p2 = nh * nh, p4 = p2 * p2, p8 = p4 * p4;
    // normalised by (n + 8) / 8, to conserve energy
    float shine = fresnel * (SKIN_SHARPNESS + 8.0) * 0.125 * p8 * p4 * p2;
    // rough surfaces [Oren 1994] in the form of [Fujii 2012], without interreflection
    float s = lv - max(nl, 0.0) * nv;
    float rough = s > 0.0 ? min(s / max(max(nl, nv), 1e-3), 1.0) : s;
    float grazing = (1.0 - nv) * (1.0 - nv);
    return vec3(shine, grazing * (1.0 - nv), rough);
}
