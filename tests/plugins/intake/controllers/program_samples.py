"""A program of each controller, as its editor saves it."""

FANUC = """/PROG  SCAN1
/ATTR
COMMENT\t\t= "sphere";
/MN
   1:J P[1] 100% FINE    ;
/POS
P[1:"above"]{
   GP1:
\tUF : 1, UT : 2,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX =  -195.800  mm,\tY =  1363.305  mm,\tZ =   524.812  mm,
\tW =  -179.111 deg,\tP =     -.087 deg,\tR =    20.366 deg
};
P[2]{
   GP1:
\tUF : 1, UT : 2,\t
\tJ1=    10.000 deg,\tJ2=   -20.500 deg,\tJ3=    30.000 deg,
\tJ4=     0.000 deg,\tJ5=   -45.000 deg,\tJ6=    90.000 deg
   GP2:
\tUF : 1, UT : 2,\t
\tJ1=    99.000 deg
};
/END
"""


KUKA_DAT = """&ACCESS RVP
DEFDAT SCAN PUBLIC
;FOLD
DECL E6POS XP1={X 1025.0,Y -12.5,Z 1480.0,A 10.0,B 20.0,C 30.0,S 2,T 35,E1 0.0,E2 0.0,E3 0.0,E4 0.0,E5 0.0,E6 0.0}
DECL FDAT FP1={TOOL_NO 1,BASE_NO 0,IPO_FRAME #BASE,POINT2[] " "}
GLOBAL E6AXIS XHOME={A1 0.0,A2 -90.0,A3 90.0,A4 0.0,A5 0.0,A6 1.5E1,E1 0.0}
ENDDAT
"""


KUKA_SRC = """DEF SCAN ( )
;FOLD PTP HOME Vel=100 % DEFAULT
PTP XHOME
;LIN XNOWHERE
LIN XP1
PTP {A1 5.0,A2 -80.0,A3 80.0,A4 0.0,A5 10.0,A6 0.0}
SLIN {X 1.0,Y 2.0,Z 3.0,A 90.0,B 0.0,C 0.0}
END
"""


ABB = """MODULE Scan
  ! CONST robtarget pOld:=[[0,0,0],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  CONST robtarget p10:=[[600,-5.5,800],[0.707107,0,0.707107,0],[0,-1,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  LOCAL PERS robtarget p20 := [[1,2,3],
     [0.965926,0.258819,0,0],[0,0,0,0],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]];
  TASK PERS jointtarget home:=[[0,10,-20,30,-40,50],[9E9,9E9,9E9,9E9,9E9,9E9]];
  CONST robtarget many{2}:=[[[1,0,0],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],[[2,0,0],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]];
  PROC main()
    MoveL p10, v100, fine, tool0;
    MoveAbsJ [[1,2,3,4,5,6],[9E9,9E9,9E9,9E9,9E9,9E9]]\\NoEOffs, v100, fine, tool0;
    MoveJ [[7,8,9],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]], v100, z10, tool0;
  ENDPROC
ENDMODULE
"""


UR = """def scan():
  global Waypoint_1_p=p[-.1, .2, .3, 2.221441469, -2.221441469, 0.0]
  global Waypoint_1_q=[0.5, -1.5, 1.0, -1.0, -1.57, 0.1]
  payload = [1, 2, 3]
  corner = p[x0, 0, 0, 0, 0, 0]
  # movel(p[9,9,9,0,0,0])
  movej(Waypoint_1_q, a=1.4, v=1.05)
  movel(p[0.4, 0.0, 0.25, 0, 0, 1.5707963268], a=1.2, v=0.25)
  movej([0, -1.57, 0, -1.57, 0, 0])
end
"""
