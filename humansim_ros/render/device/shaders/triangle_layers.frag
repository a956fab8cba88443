#version 330
// The lowest and the highest triangle at a pixel that the draws before have not found, of fronts and of backs.
// Blending keeps the minimum of each component: lowest and -highest front, lowest and -highest back.
uniform sampler2D found;  // the same of the draw before
uniform float none;
layout(location = 0) out vec4 ids;
void main() {
    float id = float(gl_PrimitiveID + 1);
    vec4 before = texelFetch(found, ivec2(gl_FragCoord.xy), 0);
    vec2 passed = gl_FrontFacing ? before.xy : before.zw;
    if (id <= passed.x || -id <= passed.y) {
        discard;
    }
    vec2 mine = vec2(id, -id), other = vec2(none);
    ids = gl_FrontFacing ? vec4(mine, other) : vec4(other, mine);
}
