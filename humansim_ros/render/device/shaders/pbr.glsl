// Shading of glTF 2.0 materials, by appendix B of the specification. The unit of light is the radiance of a white matt
// surface that faces it: pi is included.
uniform vec3 eye;
uniform float has_material;  // 0: matt, the uniforms below are not used
uniform float metallic, roughness, normal_scale, cutoff, opacity;
uniform vec3 specular;      // reflectance of non-metals at normal incidence (F0)
uniform vec3 emission;
uniform float brightness;    // of light of strength 1
uniform bool one_sided, masked;
uniform sampler2D metal_rough, normal_map, emissive_map, alpha_map;
uniform float min_alpha;  // GGX alpha of the sun's angular size: lower bound of alpha
float opacity_at(vec2 uv) { return opacity * texture(alpha_map, uv).r; }
// normal of a normal map; tangents follow from screen-space derivatives [Schueler 2013]
vec3 perturbed_normal(vec3 n, vec3 position, vec2 uv) {
    if (normal_scale == 0.0) return n;
    vec3 px = dFdx(position), py = dFdy(position);
    vec2 tx = dFdx(uv), ty = dFdy(uv);
    vec3 nx = cross(n, px), ny = cross(py, n);
    vec3 t = ny * tx.x + nx * ty.x, b = ny * tx.y + nx * ty.y;
    float size = max(dot(t, t), dot(b, b)), turned = dot(n, cross(px, py)) < 0.0 ? -1.0 : 1.0;
    vec3 m = texture(normal_map, uv).xyz * (255.0 / 127.5) - 1.0;
    m.xy *= normal_scale * turned;
    if (size == 0.0) return n;
    return normalize((t * m.x + b * m.y) * inversesqrt(size) + n * m.z);
}
vec3 fresnel(vec3 f0, float cosine) { return f0 + (1.0 - f0) * pow(1.0 - cosine, 5.0); }
// environment reflectance of uniform light: scale and offset of F0 [Lazarov 2013, Karis 2014]
vec2 environment_brdf(float rough, float nv) {
    vec4 r = rough * vec4(-1.0, -0.0275, -0.572, 0.022) + vec4(1.0, 0.0425, 1.04, -0.04);
    return vec2(-1.04, 1.04) * (min(r.x * r.x, exp2(-9.28 * nv)) * r.x + r.y) + r.zw;
}
vec3 shade_pbr(vec3 albedo, vec3 n, vec3 position, vec2 uv, vec3 ambient, vec3 sky, vec3 ground, vec3 sun, vec3 sunlight) {
    vec3 v = normalize(eye - position), h = normalize(v + sun), texel = texture(metal_rough, uv).rgb;
    float rough = clamp(roughness * texel.g, 0.0, 1.0), metal = clamp(metallic * texel.b, 0.0, 1.0);
    vec3 diffuse = albedo * (1.0 - metal), f0 = mix(specular, albedo, metal);
    float nv = max(dot(n, v), 1e-3), nl = max(dot(n, sun), 0.0), nh = max(dot(n, h), 0.0);
    float a = max(rough * rough, min_alpha), a2 = a * a, d = nh * nh * (a2 - 1.0) + 1.0;
    vec3 f = fresnel(f0, max(dot(v, h), 0.0));
    float visibility = 0.5 / max(nl * sqrt(nv * nv * (1.0 - a2) + a2) + nv * sqrt(nl * nl * (1.0 - a2) + a2), 1e-6);
    vec3 light = sunlight * nl * ((1.0 - fresnel(specular, max(dot(v, h), 0.0))) * diffuse + f * (a2 / (d * d) * visibility));
    // reflection of sky and ground: the rougher the surface, the wider the transition between them
    float up = reflect(-v, n).z, width = mix(0.05, 1.0, rough);
    vec2 env = environment_brdf(rough, nv);
    vec3 reflected = f0 * env.x + env.y, unoccluded = mix(ground, sky, 0.5 + 0.5 * n.z);
    vec3 occlusion = ambient / max(unoccluded, 1e-6);
    light += diffuse * (1.0 - specular * env.x - env.y) * ambient;
    light += reflected * mix(ground, sky, clamp(0.5 + 0.5 * up / width, 0.0, 1.0)) * occlusion;
    vec3 emitted = texture(emissive_map, uv).rgb;
    return light + brightness * emission * emitted * emitted;
}
