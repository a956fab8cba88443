#version 330
// Light of sky and ground at every third point of the light map, from some directions.
uniform sampler2D points;
uniform sampler2D normals;
uniform sampler2D maps;
uniform ivec2 first;           // texel of the light map
uniform ivec2 origin;          // of the image of these points
uniform vec3 directions[COUNT];
uniform vec3 axes[3 * COUNT];  // of the maps: the scene is within -1 and 1 along each
uniform ivec2 corners[COUNT];  // of the maps
uniform vec3 centre;           // of the scene
uniform float texel;           // metres
layout(location = 0) out vec4 sky;  // on the front: visible, total; on the back: visible, total
layout(location = 1) out vec4 ground;
void main() {
    ivec2 place = min(3 * (ivec2(gl_FragCoord.xy) - origin) + first, textureSize(points, 0) - 1);
    vec3 n = texelFetch(normals, place, 0).xyz, p = texelFetch(points, place, 0).xyz - centre;
    sky = ground = vec4(0.0);
    if (n == vec3(0.0)) return;  // no surface
    for (int i = 0; i < COUNT; i++) {
        float cosine = dot(n, directions[i]);
        vec3 from = p + sign(cosine) * (1.5 * texel) * n;
        vec3 lookup = vec3(dot(axes[3 * i], from), dot(axes[3 * i + 1], from), dot(axes[3 * i + 2], from + texel * directions[i]));
        ivec2 pixel = clamp(ivec2((0.5 + 0.5 * lookup.xy) * TEXELS), 0, TEXELS - 1) + corners[i];
        vec2 visible = vec2(step(0.5 + 0.5 * lookup.z, texelFetch(maps, pixel, 0).r), 1.0);
        vec4 light = vec4(visible * max(cosine, 0.0), visible * max(-cosine, 0.0));
        if (directions[i].z > 0.0) sky += light;
        else ground += light;
    }
}
