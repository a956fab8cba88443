#version 330
// Visible share of the light around a texel of the light map: of sky and ground on the front, and on the back.
uniform sampler2D sky;     // on the front: visible, total; on the back: visible, total; a third of the rows and
uniform sampler2D ground;  // columns of the light map side by side
uniform sampler2D points;  // of the size of the light map
out vec4 shares;
void main() {
    ivec2 place = ivec2(gl_FragCoord.xy), third = textureSize(sky, 0) / 3, last = textureSize(points, 0) - 1;
    vec4 of_sky = vec4(0.0), of_ground = vec4(0.0);
    for (int y = max(place.y - 1, 0); y <= min(place.y + 1, last.y); y++) {
        for (int x = max(place.x - 1, 0); x <= min(place.x + 1, last.x); x++) {
            ivec2 texel = ivec2(x % 3, y % 3) * third + ivec2(x, y) / 3;
            of_sky += texelFetch(sky, texel, 0);
            of_ground += texelFetch(ground, texel, 0);
        }
    }
    vec4 visible = vec4(of_sky.x, of_ground.x, of_sky.z, of_ground.z), total = vec4(of_sky.y, of_ground.y, of_sky.w, of_ground.w);
    shares = mix(vec4(1.0), visible / max(total, 1e-3), greaterThan(total, vec4(1e-3)));
}
